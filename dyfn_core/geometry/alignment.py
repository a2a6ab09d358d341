"""Alignment of a prediction to a target by scale and shift (paper sections 4 and 5)."""

from __future__ import annotations

from dyfn_core.geometry.l1_fit import fit_scale_shift

__all__ = ["fit_scale_shift"]
