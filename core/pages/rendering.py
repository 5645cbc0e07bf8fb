"""Render an HTML page from a template. Jinja2 is imported on the first call."""

from __future__ import annotations

import base64
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InvalidArgument, MissingExtra
from .charts import percent, series_class

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).with_name("templates")
MEDIA_TYPES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}  # by the first bytes of a file


@lru_cache(maxsize=1)
def environment() -> Environment:
    """Jinja2 environment of the pages: values are escaped, undefined ones raise.

    Raises:
        ImportError: Jinja2 is missing.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError as error:
        raise MissingExtra(
            "HTML pages need Jinja2: pip install unghost[demo], unghost[recipes] or unghost[eval]", name="jinja2"
        ) from error
    made = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters |= {"data_uri": data_uri, "percent": percent, "series_class": series_class}
    return made


def render(template: str, **values: Any) -> str:
    """Render one HTML page. Pictures, style and script are inline: the page makes no request.

    Args:
        template: file name in ``core/pages/templates``.
        values: what the template shows. Text is escaped; markup comes from the templates alone.

    Raises:
        ImportError: Jinja2 is missing.
        jinja2.UndefinedError: the template uses a value that is not given.
    """
    return environment().get_template(template).render(**values)


def data_uri(image: bytes) -> str:
    """PNG or JPEG file as a ``data:`` address for ``<img src>``.

    Raises:
        ValueError: bytes of another format.
    """
    media = next((name for start, name in MEDIA_TYPES.items() if image.startswith(start)), None)
    if media is None:
        raise InvalidArgument(f"data_uri: image must be a PNG or JPEG file, got bytes that start with {image[:8]!r}")
    return f"data:{media};base64,{base64.b64encode(image).decode('ascii')}"
