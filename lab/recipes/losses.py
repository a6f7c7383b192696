"""The loss of a model's outputs: cross-entropy for labels that are actions of a Discrete space, else the squared error."""

import numpy as np


def output_error(outputs, labels, weights):
    """Returns the weighted mean loss and its gradient by the outputs, [..., outputs].

    `labels` are [...] of integers, or [..., outputs] of floating point; `weights` are [...].
    """
    shares = weights / weights.sum()
    if np.issubdtype(labels.dtype, np.floating):
        error = outputs - labels
        return float(((error**2).sum(-1) * shares).sum()), 2 * error * shares[..., None]
    error = np.exp(outputs - outputs.max(-1, keepdims=True))
    error /= error.sum(-1, keepdims=True)
    chosen = np.take_along_axis(error, labels[..., None], -1)
    loss = -(np.log(chosen[..., 0] + 1e-12) * shares).sum()
    np.put_along_axis(error, labels[..., None], chosen - 1, -1)
    return float(loss), error * shares[..., None]
