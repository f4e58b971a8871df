"""Adjust a scene of the camera that the tutorial adds; it needs what `make derive` has written."""

import epigauge as eg
import numpy as np

rng = np.random.default_rng(0)
n, m = 6, 50
turns = rng.uniform(-0.4, 0.4, n)
R = np.array([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in turns])
t = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.full(n, 5.0)])
X = rng.uniform(-1.0, 1.0, (m, 3)) * [1.5, 1.0, 1.0]
cameras = eg.Cameras("division", [[800.0, 640.0, 480.0, -0.2]], np.zeros(n, int))
truth = eg.MetricReconstruction(R, t, X, cameras)

view, point = np.divmod(np.arange(n * m), m)
blank = eg.Tracks(view, point, np.zeros((n * m, 2)))  # sorts by point
tracks = eg.Tracks(blank.view, blank.point, truth.project(blank))
start = eg.MetricReconstruction(
    R,
    t + 0.05 * rng.standard_normal((n, 3)),
    X + 0.05 * rng.standard_normal((m, 3)),
    eg.Cameras("division", [[780.0, 640.0, 480.0, 0.0]], cameras.camera_of_view),
)
result = eg.bundle_adjust(tracks, start, refine=("f", "k"))
f, _, _, k = result.reconstruction.cameras.params[0]
print(f"{result.success} rms {result.reconstruction.rms_px(tracks):.6f} px, f {f:.3f}, k {k:.5f}")
