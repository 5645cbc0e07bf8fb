"""Loads the fixtures that several folders of tests share."""

pytest_plugins = (
    "unghost_tests.analytic",
    "unghost_tests.browser",
    "unghost_tests.photos",
    "unghost_tests.shards",
)
