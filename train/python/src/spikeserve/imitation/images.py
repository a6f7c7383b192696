"""Decides how the images of an environment are embedded."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from spikeserve.check import check

_SMALLEST_SIDE = 8  # pixels; smaller observations of three dimensions are not treated as images
_SIZES = (4, 5, 6, 7, 3, 8, 2)  # of patches, in the order of preference


def image_flags(space: spaces.Space[Any], patch_size: int | None) -> list[str]:
    """Returns the flags of `spiketrain train` for observations of this space.

    An image is a Box of uint8 numbers [height, width, channels] with sides of at least 8 pixels. It
    is embedded in square patches that fill it: of `patch_size` pixels, of a size that fits if that
    is None, or not in patches if it is 0 or none fits. ValueError for a size that does not fit.
    """
    image = is_image(space)
    if patch_size:
        check(image, "patch_size", "an image of uint8 [height, width, channels]", space)
    if not image or patch_size == 0:
        return []
    height, width, channels = space.shape  # type: ignore[misc]  # is_image() has checked it
    fitting = [size for size in _SIZES if height % size == 0 and width % size == 0]
    if patch_size is not None:
        fits = height % patch_size == 0 and width % patch_size == 0
        check(fits, "patch_size", f"a divisor of {height} and {width}", patch_size)
        fitting = [patch_size]
    if not fitting:
        return []
    return [f"--image_shape={height},{width},{channels}", f"--patch_size={fitting[0]}"]


def is_image(space: spaces.Space[Any]) -> bool:
    """Returns whether observations of this space are images."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 3:
        return False
    return space.dtype == np.uint8 and min(space.shape[:2]) >= _SMALLEST_SIDE
