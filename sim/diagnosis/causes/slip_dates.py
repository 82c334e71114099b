"""Where readings slip against a model: by whole samples, from some sample on. Nothing here knows of any stage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adaptive.compiled import compiled
from adaptive.types import BoolArray, FloatArray

#: Samples by which a column may come to run ahead or late.
MOST = 12
#: Slips beyond this number are no slips but another cause that looks like them.
MOST_SLIPS = 16
_BLOCK = 8
#: Before this sample a slip would be the recorder's latch.
_FIRST = 100
#: Between two slips there are more samples than this: lost and gained at once is no slip but a model's error.
_SHORTEST = 64

#: First sample and number of samples lost (gained where negative), in order.
Found = tuple[tuple[int, int], ...]
IntArray = NDArray[np.int64]


@compiled
def _path(cost: FloatArray, price: float) -> FloatArray:
    """The cheapest way through ``cost`` (blocks, shifts) where each step of one shift costs ``price`` (Viterbi)."""
    n, m = cost.shape
    back = np.zeros((n, m), dtype=np.int8)
    total = cost[0].copy()
    for b in range(1, n):
        for j in range(1, m):  # a change by more steps pays for each
            if total[j - 1] + price < total[j]:
                total[j] = total[j - 1] + price
                back[b, j] = back[b, j - 1] - 1
        for j in range(m - 2, -1, -1):
            if total[j + 1] + price < total[j]:
                total[j] = total[j + 1] + price
                back[b, j] = back[b, j + 1] + 1
        for j in range(m):
            total[j] += cost[b, j]
    out = np.empty(n)
    j = int(np.argmin(total))
    for b in range(n - 1, -1, -1):
        out[b] = j
        j += int(back[b, j])
    return out


def slips_of(y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> Found:
    """Where the readings slip against the model, and by how many samples: ``((index, size), ...)``; positive is lost.

    Asked of first differences, so that slow errors of the model do not matter, in blocks of eight samples. A slip has
    to save far more than the typical error of a block.
    """
    n = y_um.size // _BLOCK * _BLOCK
    moved = np.diff(y_um, prepend=y_um[:1])
    there = np.diff(model_um, prepend=model_um[:1])
    inside = mask & np.append(mask[:1], mask[:-1])
    cost = np.empty((n // _BLOCK, 2 * MOST + 1))
    for j in range(2 * MOST + 1):
        shift = j - MOST
        ahead = np.roll(there, -shift)
        error = np.square(np.where(inside, moved - ahead, 0.0))
        cost[:, j] = np.add.reduceat(error[:n], np.arange(0, n, _BLOCK))
    least = cost.min(axis=1)
    if not np.all(np.isfinite(least)):
        return ()
    cost -= least[:, None]
    # A model that is still wrong pays for that in many blocks: the price rises until few slips are left.
    price = 12.0 * max(float(np.quantile(least, 0.9)), 1e-18)
    for _ in range(12):
        path = _path(np.ascontiguousarray(cost), price)
        at = np.flatnonzero(np.diff(path)) + 1
        if at.size <= MOST_SLIPS:
            return tuple((int(b * _BLOCK), int(path[b] - path[b - 1])) for b in at)
        price *= 3.0
    return ()


@compiled
def _best_cut(before_um: FloatArray, after_um: FloatArray, first: int) -> int:
    """Sample at which the squared error of the one before it and of the other from it on is least."""
    total, least, at = 0.0, 0.0, first
    for k in range(before_um.shape[0]):
        total += before_um[k] * before_um[k] - after_um[k] * after_um[k]
        if total < least:
            least, at = total, first + k + 1
    return at


def dated(found: Found, y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> Found:
    """The slips, each at the sample from which the readings agree best with the model shifted by it.

    The most probable moment under white noise, given the other slips; each is looked for between its neighbours.
    ``model_um`` (n,) is the reading without any slip. In a rest every sample is as good as another.
    """
    out = list(found)
    n = y_um.size
    index = np.arange(n)
    for _ in range(3):
        before = list(out)
        shift = 0
        for i, (_, size) in enumerate(out):
            first = out[i - 1][0] if i > 0 else 0
            last = out[i + 1][0] if i + 1 < len(out) else n
            k = index[first:last]
            error = [
                np.where(mask[first:last], y_um[first:last] - model_um[np.clip(k + s, 0, n - 1)], 0.0)
                for s in (shift, shift + size)
            ]
            out[i] = (max(int(_best_cut(error[0], error[1], first)), 1), size)
            shift += size
        if out == before:
            break
    sizes: dict[int, int] = {}
    for at, size in out:
        sizes[at] = sizes.get(at, 0) + size
    return tuple((at, size) for at, size in sizes.items() if size)


@compiled
def _best_stretch(before_um: FloatArray, after_um: FloatArray, ends: IntArray, first: int) -> tuple[float, int, int]:
    """(gain, begin, end): from which sample on, up to which of ``ends``, the other error is less by most (µm²)."""
    best, begin, end = 0.0, 0, 0
    least, at, late, total, e = 0.0, first, 0.0, 0.0, 0
    for k in range(first, before_um.shape[0]):
        j = k - _SHORTEST
        if j >= first:
            late += before_um[j] * before_um[j] - after_um[j] * after_um[j]
            if late < least:
                least, at = late, j + 1
        total += before_um[k] * before_um[k] - after_um[k] * after_um[k]
        while e < ends.shape[0] and ends[e] <= k + 1:
            if ends[e] == k + 1 and total - least > best:
                best, begin, end = total - least, at, k + 1
            e += 1
    return best, begin, end


def moved(found: Found, y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> tuple[Found, float]:
    """The slips with one more, or one taken in two, and what that takes off the squared error, µm².

    A stretch from some sample on, up to a later slip or to the end, or from a slip on up to some sample, is shifted by
    another few samples. Asked of the readings themselves: a slip shifts all that follows, a model's error does not.
    """
    n = y_um.size
    index = np.arange(n)
    shifts = np.zeros(n, dtype=np.int64)
    for at, size in found:
        shifts[at:] += size
    ends = np.array([*(at for at, _ in found), n], dtype=np.int64)
    # Seen from the end, where a stretch begins is where it ends.
    begins = np.array([n - at for at, _ in reversed(found)], dtype=np.int64)

    def error(extra: int) -> FloatArray:
        return np.where(mask, y_um - model_um[np.clip(index + shifts + extra, 0, n - 1)], 0.0)

    now = error(0)
    back = np.ascontiguousarray(now[::-1])
    best = (0.0, 0, n, 0)
    for extra in (d for d in range(-MOST, MOST + 1) if d):
        other = error(extra)
        gain, begin, end = _best_stretch(now, other, ends, _FIRST)
        best = max(best, (gain, begin, end, extra))
        if begins.size:
            gain, late, early = _best_stretch(back, np.ascontiguousarray(other[::-1]), begins, 0)
            best = max(best, (gain, n - early, n - late, extra))
    gain, begin, end, extra = best
    sizes = dict(found)
    for at, by in ((begin, extra), (end, -extra)):
        if at < n:
            sizes[at] = sizes.get(at, 0) + by
    return tuple((at, size) for at, size in sorted(sizes.items()) if size), gain


def pruned(found: Found) -> Found:
    """The slips without those that a later one soon takes back (stretches too short are given to their neighbours),
    and without one at the beginning, which is a latch."""
    out: list[tuple[int, int]] = []
    for at, size in found:
        if at < _FIRST:
            continue
        if out and at - out[-1][0] <= _SHORTEST:
            before, its = out.pop()
            at, size = before, its + size
        if size:
            out.append((at, size))
    return tuple(out)
