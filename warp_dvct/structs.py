"""Warp structs on the host."""

from __future__ import annotations

from typing import Any


def with_fields(kind: Any, struct: Any, **changed: Any) -> Any:
    """A copy of a struct of Warp's ``kind`` on the same arrays, with some fields changed."""
    copy = kind()
    for name in kind.vars:
        setattr(copy, name, changed[name] if name in changed else getattr(struct, name))
    return copy
