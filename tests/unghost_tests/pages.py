"""Reading the project's HTML pages in tests."""

import re
from html.parser import HTMLParser

HOSTILE = '<img src=x onerror="alert(1)">&\'</script><script>alert(2)</script>'
VOID = {"meta", "link", "img", "input", "br"}
ADDRESSES = ("src", "href", "action", "data", "srcset", "poster")


class Reader(HTMLParser):
    """Tags with their attributes and texts of a page; what opens must close."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.text, self._open = [], [], []
        self.feed(text)
        assert self._open == []

    def count(self, tag):
        return sum(name == tag for name, _ in self.tags)

    @property
    def words(self):
        return " ".join(self.text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag, (tag, self._open)

    def handle_data(self, data):
        self.text.append(data)


def read_page(text):
    """The page, after checks that hold for every page: tags nest, and nothing is fetched."""
    page = Reader(text)
    for tag, attributes in page.tags:
        for key in ADDRESSES:
            assert (attributes.get(key) or "data:").startswith("data:"), (tag, key)
        assert not [key for key in attributes if key.startswith("on")], (tag, attributes)  # no inline handlers
    assert page.tags[0][0] == "html"
    outside = re.sub(r"base64,[\w+/=]+", "", text)
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest", outside)
    return page
