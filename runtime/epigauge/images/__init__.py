"""From photographs to point matches, by OpenCV.

OpenCV is imported only when it is needed: ``pip install 'epigauge[cv]'``.
"""

from epigauge.images.loading import load_image
from epigauge.images.matching import DETECTORS, ImageMatches, match_images

__all__ = ["DETECTORS", "ImageMatches", "load_image", "match_images"]
