"""Things in demonstrations, by their colours: docs/general_memory.md and docs/learning_the_rule.md."""

import hashlib
import math
from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from vla_eval.models.shared.images import MAX_LEVEL

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Color = NDArray[np.float64]

N_LEVELS = 256  # of a channel
BIN = 8  # levels of a channel that count as one
LEAST_PX = 8  # a smaller piece is noise of the video
SAME_COLOR = 45.0  # distance in levels; red and maroon, cyan and teal, yellow and orange differ by more
HUE_EDGES = (0.35, 0.87)  # of a channel relative to the strongest: orange's green is between, yellow's above
IN_ITS_PLANE = ndimage.generate_binary_structure(2, 1)[None] & np.array([False, True, False])[:, None, None]
# What a cube's faces have of the colour of its top, which is what an arm at rest sees of it
# (docs/general_memory.md).
FACES = (1.0, 0.8, 0.65)
SAME_FACE = 25.0  # distance in levels; the top of maroon and a side of red differ by 16, and are parted
BRIGHT_SHARE = 0.3  # of a thing's pixels: its side towards the light, whose colour is compared
MOST_SEEN = 2**15  # images: both cameras of 500 episodes of 32 steps, at most 200 MB of things


class Thing(NamedTuple):
    """A piece of an image: its `box` (rows, columns) with a pixel around, its pixels, its `color` (3,)."""

    box: tuple[slice, slice]
    mask: Mask
    color: Color


def usual_colors(image: Bytes) -> Mask:
    """Return (32, 32, 32): which colours (red, green, blue) an image (3, H, W) has, or nearly has."""
    n_bins = N_LEVELS // BIN
    red, green, blue = image // BIN
    found = np.zeros((n_bins,) * 3, dtype=np.bool_)
    found[red, green, blue] = True
    return _widened(found)


def _widened(mask: Mask) -> Mask:
    """Return the mask with the neighbours of what is in it, those at corners, too."""
    wide: Mask = ndimage.maximum_filter(mask, 3)  # half the time of binary_dilation, the same pixels
    return wide


class Empty:
    """What a camera sees, (3, H, W), before there is anything to choose from."""

    def __init__(self, image: Bytes) -> None:
        self.image = image
        self.digest = _digest(image)

    @cached_property
    def usual(self) -> Mask:
        """See `usual_colors`."""
        return usual_colors(self.image)


class SeenThings:
    """Finds things, and keeps what it found for `most` images, those last asked for: samples repeat."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: OrderedDict[bytes, tuple[Thing, ...]] = OrderedDict()

    def things_in(self, image: Bytes, empty: Empty) -> tuple[Thing, ...]:
        """Return the things in an image (3, H, W)."""
        key = _digest(image) + empty.digest
        found = self._found.get(key)
        if found is None:
            found = things_in(image, empty.usual)
            if len(self._found) == self._most:
                self._found.popitem(last=False)
            self._found[key] = found
        else:
            self._found.move_to_end(key)
        return found


def _digest(image: Bytes) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image), digest_size=16).digest()


_SEEN = SeenThings(MOST_SEEN)


def things_in(image: Bytes, usual: Mask) -> tuple[Thing, ...]:
    """Return the things in an image (3, H, W), given the colours that are none."""
    red, green, blue = image // BIN
    unusual = ~usual[red, green, blue]
    if np.count_nonzero(unusual) < LEAST_PX:
        return ()
    rows, columns = ndimage.find_objects(_widened(unusual).astype(np.int8))[0]
    part = image[:, rows, columns]
    numbers = _numbered(unusual[rows, columns], _hues(part))
    # The part has an edge around all things, too, but where the image ends.
    boxes = [
        tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in box)
        for box in ndimage.find_objects(numbers)
    ]
    masks = [numbers[box] == number for number, box in enumerate(boxes, start=1)]
    return tuple(
        Thing(
            (_later(down, rows), _later(across, columns)), mask, _bright_color(part[:, down, across][:, mask])
        )
        for (down, across), mask in zip(boxes, masks, strict=True)
    )


def _later(side: slice, begin: slice) -> slice:
    """Return a side of a box in a part of an image as one of the image, which ends where the part does."""
    return slice(begin.start + side.start, min(begin.start + side.stop, begin.stop))


def _hues(image: Bytes) -> NDArray[np.int64]:
    """Return (H, W) a number for the hue of each pixel, the same in the light and in the shade."""
    shares = image / np.maximum(image.max(axis=0), 1)
    first, second = HUE_EDGES
    red, green, blue = (shares >= first).astype(np.int64) + (shares >= second)
    hues: NDArray[np.int64] = 9 * red + 3 * green + blue
    return hues


def _numbered(unusual: Mask, hues: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (H, W) which thing a pixel belongs to, from 1; 0: none. What lies between goes to the nearer."""
    planes = unusual & (hues == np.unique(hues[unusual])[:, None, None])
    parts, _ = ndimage.label(planes, IN_ITS_PLANE)
    is_core = np.bincount(parts.ravel()) >= LEAST_PX
    is_core[0] = False
    cores = np.where(is_core, np.cumsum(is_core), 0)[parts].sum(axis=0)
    pieces, _ = ndimage.label(unusual)
    rows, columns = ndimage.distance_transform_edt(cores == 0, return_distances=False, return_indices=True)
    same_piece = unusual & (pieces == pieces[rows, columns])
    return np.where(same_piece, cores[rows, columns], 0)


def _bright_color(pixels: Bytes) -> Color:
    """Return the mean (3,) of the brightest of pixels (3, N)."""
    light = pixels.sum(axis=0, dtype=np.int64)
    least = math.ceil((len(light) - 1) * (1 - BRIGHT_SHARE))
    color: Color = pixels[:, light >= np.partition(light, least)[least]].mean(axis=1)
    return color


def groups_of(things: Sequence[Thing]) -> tuple[list[int], NDArray[np.float64]]:
    """Return the group of each thing, and the colours (groups, 3): things of one colour are a group."""
    colors: list[Color] = []
    groups = []
    for thing in things:
        away = [float(np.linalg.norm(thing.color - color)) for color in colors]
        if not away or min(away) > SAME_COLOR:
            colors.append(thing.color)
            away.append(0.0)
        groups.append(int(np.argmin(away)))
    return groups, np.array(colors).reshape(-1, 3)


def face_of(thing: Thing, colors: NDArray[np.float64]) -> tuple[int, float] | None:
    """Return the group of `colors` (groups, 3) that a thing shows a face of, and which share of the colour.

    None: it is none of them.
    """
    faces = colors[:, None] * np.array(FACES)[:, None]
    away = np.linalg.norm(faces - thing.color, axis=-1)
    group, face = divmod(int(away.argmin()), len(FACES))
    return (group, FACES[face]) if away[group, face] <= SAME_FACE else None


def changed_things(
    images: Tensor, empty: Tensor, *, n_before: int, erases: bool, exchanges: bool, may_stay: float = 1.0
) -> Tensor:
    """Return the images of an episode with other things; drawn by torch's generator.

    Nothing changes where no thing from the decision on has a colour that was shown before.

    Args:
        images: (frames, cameras, 3, H, W) uint8.
        empty: (cameras, 3, H, W) uint8, the frame before the first decision.
        n_before: how many of the frames are before it.
        erases: of the colours that appear only at the decision, a random number is replaced by `empty`; one
            always stays. Only if the decision is the last frame: later, the arm has moved its camera.
        exchanges: all colours of things change places, alike in all frames; shades are kept. A moving arm
            sees sides of things, which are darker: they change with the thing whose faces they are. What is
            no face of a thing that was seen up to the decision stays as it is.
        may_stay: where things are erased, at most so large a share of the others stays.
    """
    before, after = images.cpu().numpy(), images.cpu().numpy().copy()
    nothing = [Empty(image) for image in empty.cpu().numpy()]
    n_frames = len(before)
    found = [
        (frame, camera, thing)
        for frame in range(n_frames if exchanges else n_before + 1)
        for camera, seen in enumerate(nothing)
        for thing in _SEEN.things_in(before[frame, camera], seen)
    ]
    at_rest = [one for one in found if one[0] <= n_before]
    groups, colors = groups_of([thing for _, _, thing in at_rest])
    shown = {group for group, (frame, _, _) in zip(groups, at_rest, strict=True) if frame < n_before}
    choices = {group for group, (frame, _, _) in zip(groups, at_rest, strict=True) if frame == n_before}
    if not shown & choices:
        return images
    erased = _drawn(sorted(choices - shown), may_stay) if erases and n_frames == n_before + 1 else frozenset()
    others = colors[torch.randperm(len(colors)).numpy()] if exchanges else colors
    faces: list[tuple[int, float] | None] = [(group, 1.0) for group in groups]
    faces += [face_of(thing, colors) for _, _, thing in found[len(at_rest) :]]
    for (frame, camera, thing), face in zip(found, faces, strict=True):
        if face is None:
            continue
        group, share = face
        part = (slice(None), *thing.box)
        place, mask = after[frame, camera][part], thing.mask
        if group in erased:
            mask = _widened(mask)
            place[:, mask] = nothing[camera].image[part][:, mask]
        elif exchanges:
            shade = share * before[frame, camera][part][:, mask].max(axis=0) / thing.color.max()
            place[:, mask] = (others[group][:, None] * shade).round().clip(0, MAX_LEVEL)
    return torch.from_numpy(after).to(images.device)


def _drawn(wrong: Sequence[int], may_stay: float) -> frozenset[int]:
    """Return those to erase: one to so large a share of them stays, each number as often."""
    if len(wrong) < 2:
        return frozenset()
    most = 1 + round((len(wrong) - 1) * may_stay)
    n_left = 1 + int(torch.randint(most, (1,)))
    return frozenset(wrong[i] for i in torch.randperm(len(wrong))[n_left:].tolist())
