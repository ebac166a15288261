"""Make test motions to record a log with."""

from typing import Any

import numpy as np

from lyceum_warp.support.validate import check_word, positive_number, whole_number

_KINDS = ("chirp", "steps", "walk")


def excitation(
    low: Any,
    high: Any,
    kind: str = "chirp",
    *,
    seconds: float = 20.0,
    rate: float = 50.0,
    frequencies: tuple[float, float] = (0.1, 5.0),
    hold: float = 0.5,
    seed: int = 0,
) -> np.ndarray:
    """Make controls that move all joints within limits, so that a log of them tells parameters apart.

    Record several kinds: chirps show inertia and delay, steps show gains and damping, and random walks show friction.
    The motion begins in the middle of the limits and grows within the first second.

    Args:
        low: Lower limits of the controls, (nu,).
        high: Upper limits of the controls, (nu,).
        kind: "chirp" (sines whose frequency rises; each joint has its own), "steps" (random targets), or "walk" (smooth
            random motion).
        seconds: Duration.
        rate: Controls per second.
        frequencies: First and last frequency of chirps in Hz; the last is also the bandwidth of "walk".
        hold: Mean seconds between steps.
        seed: Seed of the random numbers.

    Returns:
        Controls, (seconds * rate, nu).

    Raises:
        ValueError: An argument is invalid.
    """
    check_word("kind", kind, _KINDS)
    seconds, rate = positive_number("seconds", seconds, "seconds"), positive_number("rate", rate, "Hz")
    hold = positive_number("hold", hold, "seconds")
    low, high = np.broadcast_arrays(np.atleast_1d(np.asarray(low, float)), np.asarray(high, float))
    if low.ndim != 1 or not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError(f"the limits of an excitation must be finite, and low below high: {low} and {high}")
    first, last = (positive_number("frequencies", f, "Hz") for f in frequencies)
    rng = np.random.default_rng(whole_number("seed", seed, low=0))
    count, n = max(2, round(seconds * rate)), len(low)
    time = np.arange(count)[:, None] / rate
    if kind == "chirp":
        phase = rng.uniform(0.0, 2.0 * np.pi, n)
        # joints sweep at different speeds, so that they do not move together
        reach = last * rng.uniform(0.6, 1.0, n)
        wave = np.sin(2.0 * np.pi * (first * time + 0.5 * (reach - first) * time**2 / seconds) + phase)
    elif kind == "steps":
        change = (rng.random((count, n)) < 1.0 / max(1.0, hold * rate)) | (np.arange(count)[:, None] == 0)
        draws, rows = rng.uniform(-1.0, 1.0, (count, n)), np.where(change, np.arange(count)[:, None], 0)
        wave = np.take_along_axis(draws, np.maximum.accumulate(rows, axis=0), axis=0)
    else:
        spectrum = np.fft.rfft(rng.standard_normal((count, n)), axis=0)
        spectrum[np.fft.rfftfreq(count, 1.0 / rate) > last] = 0.0
        wave = np.fft.irfft(spectrum, count, axis=0)
        wave = np.clip(0.5 * wave / wave.std(axis=0), -1.0, 1.0)
    result: np.ndarray = 0.5 * (low + high) + 0.5 * (high - low) * np.minimum(1.0, time) * wave
    return result
