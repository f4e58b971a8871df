"""Covariances beside those of COLMAP (Ceres), in the gauge that it has: two views held fixed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest

from tests.metric_scenes import metric_scene

pycolmap: Any = pytest.importorskip("pycolmap", reason="needs pycolmap")


def test_poses_and_intrinsics_have_the_covariance_that_colmap_gives(tmp_path: Path) -> None:
    tracks, scene = metric_scene(
        "SIMPLE_RADIAL", 3, n_views=6, n_points=60, n_cameras=1, noise_px=0.5
    )
    refine = ("f", "k")
    options: dict[str, Any] = {"refine": refine, "fixed_views": [0, 1]}
    found = eg.bundle_adjust(tracks, scene, ftol=1e-14, **options).reconstruction
    names = [f"{i}.jpg" for i in range(6)]
    named = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=names)
    (tmp_path / "sparse").mkdir()
    eg.save_scene(tmp_path / "sparse", named, found)
    ours = eg.covariance(tracks, found, noise_px=1.0, **options)

    theirs = pycolmap.Reconstruction(tmp_path / "sparse")
    config = pycolmap.BundleAdjustmentConfig()
    by_name = {image.name: image for image in theirs.images.values()}
    for image in by_name.values():
        config.add_image(image.image_id)
    for name in names[:2]:
        config.set_constant_rig_from_world_pose(by_name[name].frame_id)
    asked = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=True, refine_principal_point=False, refine_extra_params=True
    )
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(asked, config, theirs)
    if not isinstance(adjuster, pycolmap.CeresBundleAdjuster):
        pytest.skip("covariances in this pycolmap do not take the adjuster that it makes")
    adjuster.solve()
    what = pycolmap.BACovarianceOptions(damping=0.0)
    spread = pycolmap.estimate_ba_covariance(what, theirs, adjuster)
    assert spread is not None
    for i in (2, 5):
        image = by_name[names[i]]
        R = image.cam_from_world().rotation.matrix()
        t = image.cam_from_world().translation
        # Theirs: half the rotation about the camera's axes, and t. Ours: rotation about the axes
        # of the scene, R -> R exp(-a), and the centre.
        slope = np.zeros((6, 6))
        slope[:3, :3] = -0.5 * R
        slope[3:, :3], slope[3:, 3:] = np.cross(t, np.eye(3)).T @ R, -R
        known = slope @ ours.camera(i) @ slope.T
        size = np.sqrt(np.diagonal(known))
        np.testing.assert_allclose(
            spread.get_cam_cov_from_world(image.image_id) / np.outer(size, size),
            known / np.outer(size, size),
            atol=1e-4,
        )
    camera = next(iter(theirs.cameras.values()))
    block = spread.get_other_params_cov(camera.params)
    own = [0, 3]
    np.testing.assert_allclose(block, ours.intrinsics(0)[np.ix_(own, own)], rtol=1e-4)
