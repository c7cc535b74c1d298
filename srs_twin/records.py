"""Records: dataclasses whose fields are arrays with the samples first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

Record = TypeVar("Record")


def joined(parts: Sequence[Record]) -> Record:
    """Return several records of one kind, one after the other, as one.

    Args:
        parts: one or more; like fields have like shapes but for the samples. One alone is returned itself.
    """
    if len(parts) == 1:
        return parts[0]
    kind: Any = type(parts[0])
    return kind(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(kind)))
