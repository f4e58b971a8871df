"""Scenes for programs that show them: glTF (binary), and ``transforms.json`` of NeRF programs.

Both take cameras that look along -z with y up (OpenGL); here they look along z with y down. Both
are written, not read: neither holds observations.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.io.output import json_text, writing
from epigauge.multi_view.tracks import Tracks

__all__ = ["write_gltf", "write_transforms"]

Array = NDArray[np.float64]

#: From the axes of OpenGL's cameras to these, and back.
_TURN = np.diag([1.0, -1.0, -1.0])

#: Names in transforms.json of what follows f and the principal point, by model.
_DISTORTIONS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
_FLOAT, _BYTE, _POINTS, _VERTICES = 5126, 5121, 0, 34962
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def write_transforms(path: Path, tracks: Tracks, scene: MetricReconstruction) -> None:
    """Write ``transforms.json``: intrinsics and pose of every image.

    Raises
    ------
    ArgumentError
        If names or sizes of the images are not known, or the camera model has no name there.
    """
    model = scene.cameras.model
    if model not in _DISTORTIONS:
        needed = f"one of {', '.join(_DISTORTIONS)}"
        raise ArgumentError("reconstruction", f"has cameras of the model {model!r}", needed)
    for name in ("names", "sizes"):
        if getattr(tracks, name) is None:
            raise ArgumentError(f"tracks.{name}", "are not known", "those of the images")
    assert tracks.names is not None
    assert tracks.sizes is not None
    own = [_intrinsics(model, row) for row in scene.cameras.params]
    frames = []
    for i, name in enumerate(tracks.names):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = scene.R[i].T @ _TURN, scene.centres[i]
        size = {"w": int(tracks.sizes[i, 0]), "h": int(tracks.sizes[i, 1])}
        frame: dict[str, Any] = {"file_path": name, "transform_matrix": pose.tolist()}
        frames.append(frame | size | own[int(scene.cameras.camera_of_view[i])])
    fisheye = "FISHEYE" in model
    document: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    shared = {k: v for k, v in frames[0].items() if k not in ("file_path", "transform_matrix")}
    if all(frame[k] == v for frame in frames for k, v in shared.items()):
        document |= shared
        for frame in frames:
            for k in shared:
                del frame[k]
    with writing(path) as file:
        file.write(json_text(document | {"frames": frames}).encode() + b"\n")


def _intrinsics(model: str, params: Array) -> dict[str, float]:
    one_focal = model not in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")
    values = params.tolist()
    f = [values[0], values[0]] if one_focal else values[:2]
    cx, cy, *rest = values[1 if one_focal else 2 :]
    named = dict(zip(_DISTORTIONS[model], rest, strict=True))
    return {"fl_x": f[0], "fl_y": f[1], "cx": cx, "cy": cy} | named


def write_gltf(path: Path, tracks: Tracks, scene: MetricReconstruction) -> None:
    """Write points with colours, and cameras, as binary glTF 2.0 (``.glb``).

    The middle of the images' sizes, or else of what was seen, frames the cameras; distortion is
    left out, since glTF has none.
    """
    X = np.ascontiguousarray(scene.X, dtype="<f4")
    rgba = np.full((len(X), 4), 255, np.uint8)
    rgba[:, :3] = 128 if tracks.colours is None else tracks.colours
    binary = X.tobytes() + rgba.tobytes()
    sizes = _frames(tracks)
    nodes: list[dict[str, Any]] = [
        {"name": "scene", "rotation": [1, 0, 0, 0], "children": list(range(1, len(sizes) + 2))},
        {"name": "points", "mesh": 0},
    ]
    cameras = []
    f = _focal_lengths(scene)
    for i, (width, height) in enumerate(sizes.tolist()):
        matrix = np.eye(4)
        # BAL's cameras, whose f counts as negative, have OpenGL's axes already.
        matrix[:3, :3] = scene.R[i].T @ (np.eye(3) if f[i] < 0.0 else _TURN)
        matrix[:3, 3] = scene.centres[i]
        view = 2.0 * math.atan(height / (2.0 * abs(f[i])))
        lens = {"yfov": view, "aspectRatio": width / height, "znear": 0.01}
        cameras.append({"type": "perspective", "perspective": lens})
        name = f"view {i}" if tracks.names is None else tracks.names[i]
        nodes.append({"name": name, "camera": i, "matrix": matrix.T.ravel().tolist()})
    document = {
        "asset": {"version": "2.0", "generator": "epigauge"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "cameras": cameras,
        "meshes": [
            {"primitives": [{"mode": _POINTS, "attributes": {"POSITION": 0, "COLOR_0": 1}}]}
        ],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": X.nbytes, "target": _VERTICES},
            {
                "buffer": 0,
                "byteOffset": X.nbytes,
                "byteLength": rgba.nbytes,
                "target": _VERTICES,
            },
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(X),
                "type": "VEC3",
                "min": X.min(axis=0).tolist(),
                "max": X.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": _BYTE,
                "normalized": True,
                "count": len(X),
                "type": "VEC4",
            },
        ],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    with writing(path) as file:
        total = 12 + 8 + len(text) + 8 + len(binary)
        file.write(b"glTF" + struct.pack("<II", 2, total))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", len(binary), _BINARY) + binary)


def _frames(tracks: Tracks) -> Array:
    """Return width and height of each image, or of what was seen in it."""
    if tracks.sizes is not None:
        return np.asarray(tracks.sizes, dtype=np.float64)
    low = np.array([tracks.xy[tracks.view == i].min(axis=0) for i in range(tracks.n_views)])
    high = np.array([tracks.xy[tracks.view == i].max(axis=0) for i in range(tracks.n_views)])
    return np.asarray(np.maximum(high - low, 1.0))


def _focal_lengths(scene: MetricReconstruction) -> Array:
    """Return fy of each view; of cameras without an optical axis one that shows a right angle."""
    try:
        return np.asarray(scene._calibrations()[:, 1, 1])
    except ArgumentError:
        return 0.5 * scene.cameras.of_views[:, 1]
