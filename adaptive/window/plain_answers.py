"""`adaptive.window.steps` in numpy, behind the same names."""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray
from adaptive.window import arrays as ws
from adaptive.window.arrays import WindowArrays
from adaptive.window.plain_parts import design, half_small, kernel, multiply


def predict(A: WindowArrays, x: FloatArray) -> float:
    """As `window_answers.predict`."""
    return float(kernel(A, x) @ A.V[ws.ALPHA] + design(A, x) @ A.beta)


def predict_with_variance(A: WindowArrays, x: FloatArray) -> tuple[float, float, float]:
    """As `window_answers.predict_with_variance`."""
    k, h = kernel(A, x), design(A, x)
    half = half_small(A, h - A.S @ k)
    latent = 1.0 - k @ multiply(A, k) + half @ half
    return float(k @ A.V[ws.ALPHA] + h @ A.beta), max(float(latent), 0.0), scale(A)


def scale(A: WindowArrays) -> float:
    """As `window_answers.scale`."""
    degrees = int(A.C[ws.COUNT]) - A.beta.size
    return max(float(A.V[ws.Y] @ A.V[ws.ALPHA]), 0.0) / degrees if degrees > 0 else 0.0


def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """As `window_answers.leave_one_out`."""
    n = A.C[ws.COUNT]
    half = half_small(A, A.S[:, :n])
    diagonal = np.diag(A.P)[:n]
    without = diagonal - np.sum(half * half, axis=0)
    known = without > ws.UNDETERMINED * diagonal
    out[:n] = np.where(known, A.V[ws.ALPHA, :n] / np.where(known, without, 1.0), np.nan)


def worst_residual(A: WindowArrays) -> float:
    """As `window_answers.worst_residual`."""
    n = A.C[ws.COUNT]
    return float(np.max(np.abs(A.V[ws.Y, :n] - A.R[:n] @ A.V[ws.ALPHA] - A.beta @ A.H[:, :n]), initial=0.0))
