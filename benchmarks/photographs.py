"""Photographs to a metric scene: time and focal length, beside COLMAP's whole pipeline.

    python benchmarks/photographs.py FOLDER [--features 4000]

Both look for as many features in each photograph of the folder, match all pairs, and reconstruct
with one SIMPLE_RADIAL camera of unknown focal length, on one thread: processor time.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import epigauge as eg


def ours(paths: list[Path], features: int) -> None:
    """Print what epigauge takes and finds."""
    begin = time.process_time()
    stages: dict[str, float] = {}

    def told(what: str, done: int, count: int) -> None:
        stages.setdefault(what, time.process_time() - begin)

    tracks = eg.build_tracks(paths, max_features=features, progress=told)
    stages["scene"] = time.process_time() - begin
    found = eg.metric_upgrade(tracks, image_size=tracks.sizes)
    stages["end"] = time.process_time() - begin
    names = list(stages)
    spent = ", ".join(f"{a} {stages[b] - stages[a]:.1f}" for a, b in itertools.pairwise(names))
    print(
        f"epigauge: {tracks.n_views} of {len(paths)}, {tracks.n_points} points, "
        f"{len(tracks)} observations, f = {found.focal_px:.2f} +- {found.focal_std_px:.2f}, "
        f"rms {found.rms_px:.3f} px; {stages['end']:.1f} s ({spent})"
    )


def colmap(paths: list[Path], features: int) -> None:
    """Print what COLMAP takes and finds."""
    import pycolmap

    options: Any = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    options.sift.max_num_features = features
    matching: Any = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        times = [time.process_time()]
        pycolmap.extract_features(
            database,
            paths[0].parent,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL"),
            extraction_options=options,
        )
        times.append(time.process_time())
        pycolmap.match_exhaustive(database, matching_options=matching)
        times.append(time.process_time())
        pipeline = pycolmap.IncrementalPipelineOptions(num_threads=1)
        found = pycolmap.incremental_mapping(database, paths[0].parent, folder, pipeline)
        times.append(time.process_time())
    best = max(found.values(), key=lambda scene: scene.num_reg_images())
    camera = next(iter(best.cameras.values()))
    extract, match, scene = (b - a for a, b in itertools.pairwise(times))
    print(
        f"COLMAP: {best.num_reg_images()} of {len(paths)}, {best.num_points3D()} points, "
        f"{best.compute_num_observations()} observations, f = {camera.params[0]:.2f}; "
        f"{times[-1] - times[0]:.1f} s (features {extract:.1f}, pairs {match:.1f}, "
        f"scene {scene:.1f})"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--features", type=int, default=4000)
    given = parser.parse_args()
    photographs = sorted(p for p in given.folder.iterdir() if p.suffix.lower() == ".jpg")
    try:
        import cv2

        cv2.setNumThreads(1)
    except ImportError:
        pass
    ours(photographs, given.features)
    colmap(photographs, given.features)
