"""All topics that are shown of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from coopenv.backends.mcap.view import View
    from coopenv.observers import Run
    from coopenv.observers.recording import Recording


def check_installed() -> None:
    """Refuse before any work to make what needs Foxglove's SDK. Raises CoopenvError: the extra `log` lacks it."""
    try:
        import foxglove.messages  # noqa: F401
    except ImportError:
        raise CoopenvError("scenes for Foxglove need an extra: pip install '.[log]', or --no-scene") from None


def views(recording: Recording, run: Run, *, start: float = 0.0, gain: bool = False) -> list[View]:
    """Return the topics that Foxglove and Lichtblick show, to give to `write_recording`.

    Args:
        recording: what the vehicles sense.
        run: of an observer on that recording, whose estimates are shown.
        start: s since 1970, when tick 0 was.
        gain: whether the observer's P is a gain matrix, so that it is not shown as a covariance.

    Raises:
        CoopenvError: Foxglove's SDK is not installed.
    """
    check_installed()
    from foxglove import messages as fox

    from coopenv.backends.mcap.view import Clock, View, ros_definition
    from coopenv.viz.foxglove import camera, estimates, motion, scene
    from coopenv.viz.foxglove.shown import Shown

    shown = Shown(recording, run, Clock(recording.dt, start), gain)

    def published(topic: str, kind: Any, messages: Iterable[tuple[int, bytes]]) -> View:
        schema = kind.get_schema()
        return View(topic, schema.name, schema.encoding, schema.data, "protobuf", messages)

    found = [
        published("/scene/world", fox.SceneUpdate, scene.world(shown)),
        published("/scene/vehicles", fox.SceneUpdate, scene.vehicles(shown)),
        published("/tf", fox.FrameTransforms, motion.transforms(shown)),
        published("/scene/sight", fox.SceneUpdate, motion.sight(shown)),
    ]
    if len(scene.moving_landmarks(shown)):
        found.append(published("/scene/landmarks", fox.SceneUpdate, motion.landmarks(shown)))
    if not gain:
        found.append(published("/scene/uncertainty", fox.SceneUpdate, motion.uncertainty(shown, scene.extent(shown))))
    for i, name in enumerate(shown.names):
        pose = View(
            f"/{name}/estimate",
            estimates.POSE,
            "ros2msg",
            ros_definition(estimates.POSE),
            "cdr",
            estimates.poses(shown, i),
        )
        error = View(
            f"/{name}/error", estimates.ERROR, "jsonschema", estimates.ERROR_SCHEMA, "json", estimates.errors(shown, i)
        )
        found += [pose, error]
        one = shown.camera(i)
        if one is not None:
            found += [
                published(f"/{name}/camera/calibration", fox.CameraCalibration, camera.calibration(shown, i, one)),
                published(f"/{name}/camera/image", fox.CompressedImage, camera.image(shown, i, one)),
                published(f"/{name}/camera/annotations", fox.ImageAnnotations, camera.annotations(shown, i, one)),
            ]
    return found
