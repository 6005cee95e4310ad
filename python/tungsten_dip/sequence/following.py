"""One frame after another: the first is fitted, the others start from its network and from the frame before.

Where the cameras are known, what the previous frame's result shows of the next is moved into place and guides
it (`reprojection`): then few pilots are enough, a network of its own blends them, and noise averages
out over the frames. Otherwise a frame has the first one's pilots, and starts from its network. A cut is
detected by the features (little of the previous frame is in sight) or by the error, and fitted anew.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tungsten_dip.buffers.prefilter import prefilter_feature
from tungsten_dip.buffers.render_buffers import FEATURES, Halves, RenderBuffers
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError
from tungsten_dip.fit import check_ready
from tungsten_dip.fit.blending import fit_blend
from tungsten_dip.fit.inference import infer_blend
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.pilots.surfaces import alpha_as_albedo
from tungsten_dip.fit.preparation.prepare import finish_result, prepare_input
from tungsten_dip.fit.presets import STEPS_OF_ONE_NETWORK
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.progress import Progress, silent
from tungsten_dip.scene.types import Camera
from tungsten_dip.sequence.flicker import estimated_flicker
from tungsten_dip.sequence.reprojection import check_camera, reproject

_LOG = logging.getLogger(__name__)

Refit = int | Literal["auto"]
How = Literal["fitted", "followed", "cut"]

_LEAST_IN_SIGHT = 0.3
"""Part of the picture that the previous frame must show of this one; below, it is another scene."""

_ALBEDO_PASSES = ((3, 1, 0.5),)
"""Passes of the pre-filter, enough to tell surfaces apart and to part light from them."""

_CUT_ERROR = 5.0
"""An error so many times the previous frame's means a cut."""


@dataclass(frozen=True)
class Models:
    """The networks that frames start from, and the first frame's own.

    Frames whose predecessor is known start from ``following``, others from ``alone``. ``first`` is what the
    first frame was denoised with, None if it has no noise. ``features`` are those of the frames so far, None
    if they are not known.
    """

    alone: Model | None = None
    following: Model | None = None
    first: Model | None = None
    features: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Followed:
    """A frame's result, how it came about and how it flickers against the one before (None: not known)."""

    result: FitResult
    how: How
    flicker: float | None = None


@dataclass(frozen=True)
class _Last:
    """What is kept of a frame for the next one. ``smooth`` is the buffers with an albedo of little noise."""

    buffers: RenderBuffers
    smooth: RenderBuffers
    camera: Camera | None
    result: FitResult


def check_can_follow(settings: FitSettings, warm_start: Model | None) -> None:
    """Raise InputError if no frames can be denoised with these settings, from the network of ``warm_start``.

    The settings may be those of the published method, which has no halves to follow, ask for another network
    than this one, or for a device that is not there.
    """
    if settings.preset == "paper":
        raise InputError("preset paper: expected draft, balanced or final; frames of it do not follow")
    check_ready(settings, warm_start)


class Follower:
    """Denoises frames in their order. ``models`` are the networks so far."""

    def __init__(self, settings: FitSettings, refit: Refit = "auto", models: Models = Models()) -> None:
        """``refit``: how many steps a frame's network is trained further, "auto" for what its error asks.

        Raises InputError as `check_can_follow` does.
        """
        check_can_follow(settings, models.alone)
        self.models = models
        self._settings = settings
        self._refit = refit
        self._threads = thread_count(settings.threads)
        self._last: _Last | None = None
        self._error: float | None = None
        self._told_of_depth = False

    def denoise(
        self, buffers: RenderBuffers, camera: Camera | None = None, progress: Progress = silent
    ) -> Followed:
        """Denoise the next frame.

        Raises InputError as `tungsten_dip.denoise` does, or if the camera took another picture.
        """
        if camera is not None:
            check_camera(camera, buffers)
            self._tell_what_is_missing(buffers)
        prepared = prepare_input(buffers, self._settings.threads)
        buffers = prepared.buffers
        smooth = self._with_smooth_albedo(buffers) if camera is not None else buffers
        how: How = "fitted"
        try:
            followed = self._follow(buffers, smooth, camera, progress)
        except _CutError as cut:
            _LOG.info("a cut: %s", cut)
            how, followed = "cut", None
        if followed is None:
            followed = Followed(fit_blend(buffers, self._settings, progress), how)
        result = followed.result
        if followed.how != "followed":
            # A network for frames that follow was fitted to what came before the cut.
            self.models = Models(alone=result.model, first=self.models.first)
        if self._last is None:
            self.models = replace(self.models, first=result.model)
        features = _features(buffers)
        if features is not None:
            self.models = replace(self.models, features=features)
        if result.gain is not None:
            # It is estimated from the fireflies of one frame, and would flicker.
            result = replace(result, color=result.color / result.gain, gain=None)
        if result.model is not None:  # An image without noise, returned as it is, tells nothing of others.
            self._error = _typical_error(result)
        self._last = _Last(buffers, smooth, camera, result)
        return replace(followed, result=finish_result(result, prepared))

    def _tell_what_is_missing(self, buffers: RenderBuffers) -> None:
        if buffers.depth is None and not self._told_of_depth:
            self._told_of_depth = True
            _LOG.warning(
                "no depth: frames cannot be moved by their cameras; they start from the first's network"
            )

    def _with_smooth_albedo(self, buffers: RenderBuffers) -> RenderBuffers:
        if buffers.albedo is None:
            return buffers
        albedo = prefilter_feature(buffers.albedo, _ALBEDO_PASSES, self._threads)
        return buffers.with_quantities(albedo=albedo)

    def _follow(
        self, buffers: RenderBuffers, smooth: RenderBuffers, camera: Camera | None, progress: Progress
    ) -> Followed | None:
        """Return what follows from the networks and the last frame, None if there is neither.

        Raises _CutError if the frame shows something else.
        """
        last = self._last
        if last is not None and last.buffers.color.mean.shape != buffers.color.mean.shape:
            raise _CutError("the previous frame had another size")
        features = _features(buffers)
        if None not in (features, self.models.features) and features != self.models.features:
            raise _CutError("the frames before had other features")
        moved = None if last is None else _moved(last, smooth, camera, self._threads)
        if moved is not None and float(np.isfinite(moved[0][:, :, 0]).mean()) < _LEAST_IN_SIGHT:
            raise _CutError("the previous frame shows little of this one")
        model = self.models.alone if moved is None else self.models.following
        if model is None and moved is None:
            return None
        steps = STEPS_OF_ONE_NETWORK if self._refit == "auto" else self._refit
        try:
            if model is not None and steps == 0:
                result = infer_blend(model, buffers, self._settings, progress, previous=moved)
            else:
                # The iterations are those of a first frame.
                settings = self._settings if moved is None else replace(self._settings, iterations=None)
                result = fit_blend(buffers, settings, progress, model, moved, refit_steps=steps)
        except InputError as problem:
            if last is None:
                raise  # The model was made for something else.
            raise _CutError(str(problem)) from problem
        if moved is None and _is_new(result.model, model):
            return Followed(result, "fitted" if last is None else "cut")
        error = _typical_error(result)
        if result.interrupted:
            error = None  # of a fit that was cut short
        if error is not None and self._error is not None and error > _CUT_ERROR * self._error:
            raise _CutError(
                f"the error, relative to radiance^2 + 0.01, is {error / self._error:.1f} times that of the "
                "last frame with noise"
            )
        kept = result.model or model
        if moved is None:
            self.models = replace(self.models, alone=kept)
        else:
            self.models = replace(self.models, following=kept)
        return Followed(result, "followed", None if last is None else _flicker(last, buffers, result))


class _CutError(Exception):
    """A frame that does not go on with what the one before showed."""


def _features(buffers: RenderBuffers) -> tuple[str, ...] | None:
    """Return the names of the features, None if the image is black.

    It shows nothing of them, not even whether the albedo is in another scale, in which it is left out.
    """
    if not buffers.color.mean.any():
        return None
    of_alpha = () if alpha_as_albedo(buffers) is None else ("alpha",)
    return (*(name for name in FEATURES if buffers.get(name) is not None), *of_alpha)


def _is_new(network: Model | None, model: Model | None) -> bool:
    """Whether a result has a network of its own: ``model`` keeps its `Blend` when it is trained further."""
    return network is not None and (model is None or network.blend is not model.blend)


def _moved(last: _Last, buffers: RenderBuffers, camera: Camera | None, threads: int) -> Halves | None:
    """Return what the last frame shows of this one, None where that is not known."""
    if camera is None or last.camera is None or last.result.halves is None:
        return None
    if buffers.depth is None or last.buffers.depth is None:
        return None
    return reproject(last.result.halves, last.smooth, last.camera, buffers, camera, threads)


def _typical_error(result: FitResult) -> float | None:
    """Return the median error of the pixels that have any: a few outliers make no cut."""
    if result.error is None:
        return None
    errors = result.error[result.error > 0]
    return float(np.median(errors)) if errors.size else None


def _flicker(last: _Last, buffers: RenderBuffers, result: FitResult) -> float | None:
    """Return the flicker as the halves show it, None unless those of both frames are the renderer's."""
    color, before = buffers.color, last.buffers.color
    if result.halves is None or last.result.halves is None:
        return None
    if color.halves is None or before.halves is None or result.halves_drawn or last.result.halves_drawn:
        return None
    return estimated_flicker(result.halves, last.result.halves, color.halves, before.halves)
