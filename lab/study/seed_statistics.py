"""Statistics over training seeds: interquartile means, bootstrap intervals, paired tests and Holm's correction.

R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021; S. Holm,
Scandinavian Journal of Statistics 6, 1979; D. Schuirmann, Journal of Pharmacokinetics and Biopharmaceutics 15, 1987.
"""

import math

import numpy as np

RESAMPLES = 10_000


def interquartile_mean(values, axis=-1):
    """Returns the mean without the lowest and the highest quarter, each rounded down to whole values."""
    ordered = np.sort(np.asarray(values, np.float64), axis=axis)
    cut = ordered.shape[axis] // 4
    return np.take(ordered, range(cut, ordered.shape[axis] - cut), axis=axis).mean(axis=axis)


def bootstrap_interval(groups, share=0.95):
    """Returns the ends of the interval of the interquartile mean of all values, by drawing each group's values anew.

    A group has the values of one task, so every resample has all tasks. The draws are always the same.
    """
    random = np.random.default_rng(0)
    resamples = [np.asarray(group)[random.integers(len(group), size=(RESAMPLES, len(group)))] for group in groups]
    means = interquartile_mean(np.concatenate(resamples, axis=1), axis=1)
    return tuple(float(end) for end in np.quantile(means, [(1 - share) / 2, (1 + share) / 2]))


def student_share(t, freedom):
    """Returns the probability that |T| < t for Student's T with whole degrees of freedom (Abramowitz, Stegun 26.7.3, 26.7.4)."""
    angle = math.atan2(abs(t), math.sqrt(freedom))
    cosine, sine = math.cos(angle), math.sin(angle)
    odd = freedom % 2
    term, total = (cosine, 0.0) if odd else (1.0, 0.0)
    for k in range(odd, freedom - 1, 2):
        total += term
        term *= cosine * cosine * (k + 1) / (k + 2)
    return 2 / math.pi * (angle + sine * total) if odd else sine * total


def half_width(values, share=0.95):
    """Returns half the width of Student's interval of the mean of at least two values."""
    values = np.asarray(values, np.float64)
    low, high = 0.0, 1e4  # of Student's t
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if student_share(middle, len(values) - 1) < share else (low, middle)
    return high * values.std(ddof=1) / math.sqrt(len(values))


def probability_above(values, bound):
    """Returns the p-value of the hypothesis that the mean is at most `bound`, by Student's t over at least two values."""
    values = np.asarray(values, np.float64)
    distance, error = values.mean() - bound, values.std(ddof=1) / math.sqrt(len(values))
    if error < 1e-12:  # all values are equal
        return 0.5 if abs(distance) < 1e-12 else float(distance < 0)
    tail = (1 - student_share(distance / error, len(values) - 1)) / 2
    return tail if distance > 0 else 1 - tail


def probability_below(values, bound):
    """Returns the p-value of the hypothesis that the mean is at least `bound`."""
    return probability_above(-np.asarray(values, np.float64), -bound)


def two_sided(values, bound):
    """Returns the p-value of the hypothesis that the mean is `bound`."""
    return min(1.0, 2 * min(probability_above(values, bound), probability_below(values, bound)))


def equivalence(values, margin):
    """Returns the p-value of the hypothesis that the mean is outside of ± margin: two one-sided tests."""
    return max(probability_above(values, -margin), probability_below(values, margin))


def holm(p_values):
    """Returns the p-values, corrected for the number of them."""
    order = np.argsort(p_values, kind="stable")
    factors = np.arange(len(p_values), 0, -1)
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(np.asarray(p_values)[order] * factors))
    return corrected.tolist()
