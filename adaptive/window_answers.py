"""What either form of the window answers: means, variances, leave-one-out residuals, what is left of its rows."""

from __future__ import annotations

from adaptive import window_cholesky as cholesky
from adaptive import window_inverse as inverse
from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_common import design_value, kernel_column, row_residual
from adaptive.window_small import dot
from adaptive.window_state import ALPHA, COUNT, FORM, INVERSE_FORM, K, WindowArrays, Y


@compiled_reassociating
def predict(A: WindowArrays, x: FloatArray) -> float:
    """Mean at one point. O(N d). Its scratch is the window's: one thread at a time."""
    k = A.V[K]
    kernel_column(A, x, k)
    mean: float = dot(k, A.V[ALPHA], A.C[COUNT])
    for c in range(A.beta.shape[0]):
        mean += A.beta[c] * design_value(A, x, c)
    return mean


@compiled_reassociating
def scale(A: WindowArrays) -> float:
    """Variance of the kernel process by its likelihood, y'alpha/(N - p): the unit of variances; 0 while N <= p."""
    n, p = A.C[COUNT], A.beta.shape[0]
    if n <= p:
        return 0.0
    total: float = max(dot(A.V[Y], A.V[ALPHA], n), 0.0)
    degrees: float = n - p
    return total / degrees


@compiled_reassociating
def predict_with_variance(A: WindowArrays, x: FloatArray) -> tuple[float, float, float]:
    """Mean, variance of the function in units of `scale`, and `scale`, at one point: one call for all. O(N²)."""
    k, p = A.V[K], A.beta.shape[0]
    kernel_column(A, x, k)
    mean: float = dot(k, A.V[ALPHA], A.C[COUNT])
    u = A.small[1, :p]
    for c in range(p):
        u[c] = design_value(A, x, c)
        mean += A.beta[c] * u[c]
    if A.C[FORM] == INVERSE_FORM:
        return mean, inverse.variance(A, k, u), scale(A)
    return mean, cholesky.variance(A, k, u), scale(A)


@compiled_reassociating
def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """Exact leave-one-out residuals into ``out`` (N,). O(N p²); in the Cholesky form as `window_diagonal` says."""
    if A.C[FORM] == INVERSE_FORM:
        inverse.leave_one_out(A, out)
    else:
        cholesky.leave_one_out(A, out)


@compiled_reassociating
def worst_residual(A: WindowArrays) -> float:
    """Largest residual of all rows, in units of the target. O(N²)."""
    n, worst = A.C[COUNT], 0.0
    for i in range(n):
        residual = abs(row_residual(A, i))
        if not residual <= worst:
            worst = residual
    return worst
