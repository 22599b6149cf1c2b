"""The background of presses: what the untouched sensor shows, from images in which a ball presses somewhere else.

    median   one for all: the per-pixel median of all presses
    near     one for each press: the mean of the REACH presses before and after it, where these leave the sensor alone

A coating wrinkles and a gel creeps, so that the untouched sensor may look different an hour later. What a median of the
session leaves far from the contacts then lies in a pattern that successive frames share and distant ones do not. Frames
next to a press show that pattern; but a mean of n of them has 1/n of a frame's noise, and a median of all has hardly
any."""

from __future__ import annotations

import numpy as np

from optics.captures.noise import Noise

REACH = 2  # presses on either side: fewer have more noise, and more blur a pattern that fades within some presses
BETTER = 0.9  # of what the median leaves: a background of each press must leave less, to be worth its noise


def near(images: np.ndarray, far: np.ndarray, median: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(backgrounds (N, H, W, C), number of presses (N, H, W) that each value is a mean of) of presses in their order.

    images   (N, H, W, C), over the gain of each;   far  (N, H, W) bool: where a press leaves the sensor alone
    median   (H, W, C), taken where no press within REACH does; it counts as all presses
    """
    found, count = [], []
    for i in range(len(images)):
        beside = [j for j in range(max(i - REACH, 0), min(i + REACH + 1, len(images))) if j != i]
        n = far[beside].sum(0)
        mean = np.einsum("nhw,nhwc->hwc", far[beside].astype(float), images[beside]) / np.maximum(n, 1)[..., None]
        found.append(np.where(n[..., None] > 0, mean, median))
        count.append(np.where(n > 0, n, len(images)))
    return np.array(found), np.array(count)


def left(images: np.ndarray, backgrounds: np.ndarray, far: np.ndarray, noise: Noise) -> np.ndarray:
    """(C,) mean square of what a background leaves of images (N, H, W, C) far from contacts, in variances of noise."""
    square = (images - backgrounds) ** 2 / noise.variance(np.broadcast_to(backgrounds, images.shape))
    return square[far].mean(0)


def with_background(noise: Noise, count: np.ndarray, far: np.ndarray) -> Noise:
    """The noise of a frame less a background that is the mean of `count` frames: (1 + 1/n) of its variance."""
    return noise.times(1 + float(np.mean(1 / count[far])))
