"""The points of live curves, from the session to the plot."""

import numpy as np


class Curves:
    """The newest points of some curves that share their times.

    Args:
        number: How many curves there are.
        capacity: Points that are kept.

    """

    def __init__(self, number: int, capacity: int = 20_000) -> None:
        self.capacity = capacity
        self._rows = np.empty((2 * capacity, 1 + number))
        self._begin = self._end = 0

    @property
    def rows(self) -> np.ndarray:
        """(points, 1 + number): times in seconds, then a value for each curve. A view."""
        return self._rows[self._begin : self._end]

    def add(self, rows: np.ndarray) -> None:
        """Append points. Where time goes back, as in a new episode, the points from that time on are dropped."""
        rows = np.asarray(rows, dtype=np.float64).reshape(-1, self._rows.shape[1])
        jumps = np.flatnonzero(np.diff(rows[:, 0]) < 0) + 1
        for part in np.split(rows, jumps):
            if len(part):
                self._append(part[-self.capacity :])

    def _append(self, rows: np.ndarray) -> None:
        self._end = self._begin + int(np.searchsorted(self.rows[:, 0], rows[0, 0]))
        if self._end + len(rows) > len(self._rows):  # moves the points to the front, once per ``capacity`` points
            kept = self.rows[-self.capacity :].copy()
            self._begin, self._end = 0, len(kept)
            self._rows[: len(kept)] = kept
        self._rows[self._end : self._end + len(rows)] = rows
        self._end += len(rows)
        self._begin = max(self._begin, self._end - self.capacity)

    def thinned(self, points: int) -> np.ndarray:
        """At most about ``points`` rows for a plot: the extremes of each curve's equal parts are kept."""
        rows = self.rows
        if len(rows) <= points:
            return rows
        edges = np.linspace(0, len(rows), points // 2 + 1).astype(int)
        low = np.minimum.reduceat(rows, edges[:-1])
        high = np.maximum.reduceat(rows, edges[:-1])
        thin = np.empty((2 * len(low), rows.shape[1]))
        thin[0::2], thin[1::2] = low, high
        return thin
