"""Target ``layout_file``: any text as a layout's YAML file.

Input: the file.
"""

from __future__ import annotations

from fuzz_input import text_of

from smartcam.exceptions import ConfigurationError, LayoutError
from smartcam.layout import Layout

__all__ = ["check"]


def check(data: bytes) -> None:
    """Read a file: a layout that writes itself back, or an error."""
    try:
        layout = Layout.from_yaml(text_of(data))
    except LayoutError as error:
        assert 0 <= error.position <= len(error.text)
        return
    except ConfigurationError as error:
        assert str(error)
        return
    assert Layout.from_yaml(layout.to_yaml()) == layout
    assert Layout.from_dict(layout.to_dict()) == layout
    assert Layout(layout.text, lenient=layout.lenient) == layout
