"""Tables in the documentation that a command writes: they stand between two comments that name them."""

from __future__ import annotations

from pathlib import Path

from warp_dvct.errors import FileError
from warp_dvct.image import write_text


def read_table(page: Path, name: str) -> str:
    """What stands between ``<!-- name -->`` and ``<!-- end of name -->``.

    Raises:
        FileError: The page cannot be read or lacks the comments.
    """
    return _parts(page, name)[1].strip("\n")


def replace_table(page: Path, name: str, table: str) -> None:
    """Put ``table`` there instead.

    Raises:
        FileError: As for :func:`read_table`, or the page cannot be written.
    """
    before, _, after = _parts(page, name)
    write_text(page, f"{before}\n\n{table}\n\n{after}")


def _parts(page: Path, name: str) -> tuple[str, str, str]:
    start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise FileError(f"{page} cannot be read: {error.strerror}") from error
    if text.count(start) != 1 or text.count(end) != 1 or text.index(start) > text.index(end):
        raise FileError(f"{page} has no table '{name}': it needs the lines {start} and {end}, once each")
    before, rest = text.split(start)
    inner, after = rest.split(end)
    return before + start, inner, end + after
