"""How near F from few raw matches of photographs comes to that of COLMAP's model, with peers.

    python benchmarks/photograph_pairs.py FOLDER [--own-cameras]

COLMAP finds features, matches all pairs and makes a model of the photographs in a folder. Of every
pair with 30 matches and 40 common points, its raw matches are undistorted by the model; the error
of an F is the median distance of the model's points, projected to both, to their epipolar lines.
The truth is that of a model made from the same matches: the same for all, not independent.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401
import numpy as np
import pycolmap
from numpy.typing import NDArray
from robust import PAIR_THRESHOLD_PX, PEERS

Array = NDArray[np.float64]

#: Matches and common points of a pair at least, features of a photograph, and bounds of errors.
MATCHES, POINTS, FEATURES, BOUNDS_PX = 30, 40, 3000, (0.5, 1.0, 2.0)


def modelled(folder: Path, work: Path, own_cameras: bool) -> tuple[Path, Any]:
    """Return the database and the largest model of the photographs in a folder."""
    database = work / "matches.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    features = pycolmap.FeatureExtractionOptions()
    features.sift.max_num_features = FEATURES
    mode = pycolmap.CameraMode.PER_IMAGE if own_cameras else pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, folder, camera_mode=mode, reader_options=reader, extraction_options=features
    )
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, folder, work)
    return database, max(models.values(), key=lambda model: model.num_reg_images())


def undistorted(camera: Any, xy: Array) -> Array:
    """Return keypoints where the camera without distortion has them."""
    K = camera.calibration_matrix()
    return np.asarray(camera.cam_from_img(xy))[:, :2] * np.diag(K)[:2] + K[:2, 2]


def pairs(database: Path, model: Any) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Give raw matches of both photographs, and where the model's points are in them."""
    with pycolmap.Database.open(database) as opened:
        for two in itertools.combinations(sorted(model.reg_image_ids()), 2):
            matches = opened.read_matches(*two)
            images = [model.image(i) for i in two]
            seen = [{p.point3D_id for p in i.points2D if p.has_point3D()} for i in images]
            common = sorted(seen[0] & seen[1])
            if len(matches) < MATCHES or len(common) < POINTS:
                continue
            X = np.array([model.points3D[k].xyz for k in common])
            raw, true = [], []
            for k, image in enumerate(images):
                camera = model.camera(image.camera_id)
                xy = opened.read_keypoints(two[k])[:, :2].astype(np.float64)
                raw.append(undistorted(camera, xy[matches[:, k]]))
                T = image.cam_from_world().matrix()
                y = (X @ T[:, :3].T + T[:, 3]) @ camera.calibration_matrix().T
                true.append(y[:, :2] / y[:, 2:])
            yield raw[0], raw[1], true[0], true[1]


def error(F: Array | None, x1: Array, x2: Array) -> float:
    """Return the median distance of matches to their epipolar lines, mean of both images."""
    if F is None:
        return np.inf
    h1, h2 = (np.column_stack([x, np.ones(len(x))]) for x in (x1, x2))
    lines2, lines1 = h1 @ F.T, h2 @ F
    apart = np.abs(np.sum(lines2 * h2, axis=1))
    both = [apart / np.hypot(line[:, 0], line[:, 1]) for line in (lines1, lines2)]
    return float(np.median(0.5 * (both[0] + both[1])))


def main() -> None:
    """Print a row an estimator."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--own-cameras", action="store_true", help="a camera for each photograph")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        chosen = list(pairs(*modelled(arguments.folder, Path(work), arguments.own_cameras)))
    print(f"{len(chosen)} pairs, {np.median([len(pair[0]) for pair in chosen]):.0f} matches\n")
    print("| | median, px | below 0.5, 1, 2 px | ms |\n|---|---|---|---|")
    for name, (_, estimate) in PEERS.items():
        errors, spent = [], []
        for x1, x2, true1, true2 in chosen:
            begun = time.process_time()
            F = estimate(x1, x2, PAIR_THRESHOLD_PX)
            spent.append(time.process_time() - begun)
            errors.append(error(F, true1, true2))
        shares = ", ".join(f"{np.mean(np.array(errors) < bound):.3f}" for bound in BOUNDS_PX)
        print(f"| {name} | {np.median(errors):.3f} | {shares} | {1e3 * np.median(spent):.1f} |")


if __name__ == "__main__":
    main()
