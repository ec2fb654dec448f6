"""Images to homography measurements: detect, track, pair, fit, decompose (knows numpy, cv2, scipy; no graph).

`measure_pair` runs all steps for two observers in one stance; each step is a module of its own. The names below are
imported on first use, so that a detector loads no optimiser.
"""

from typing import TYPE_CHECKING

from coloc_graph._lazy import lazy_names

if TYPE_CHECKING:
    from coloc_graph.frontend.homography.decomposition import (
        choose_by_normal,
        decompose_svd,
        decompose_with_normal,
        metric_scale,
    )
    from coloc_graph.frontend.homography.eq2_pose import relative_pose
    from coloc_graph.frontend.homography.fit import HomographyFit, fit_homography
    from coloc_graph.frontend.homography.ml_pose import most_likely_pose
    from coloc_graph.frontend.homography.plane import distance_from_span, on_plane, plane_from_mount
    from coloc_graph.frontend.homography.refinement import PointPairs, least_squares, refine
    from coloc_graph.frontend.images.detection import Blobs, Detector, Threshold, detect_hue, detect_leds, detector_for
    from coloc_graph.frontend.landmarks import SeenLandmarks, UnusedSighting, describe_unused, sight_landmarks
    from coloc_graph.frontend.odometry import WheelTrack
    from coloc_graph.frontend.pairing.clock_fusion import share_clock_offsets
    from coloc_graph.frontend.pairing.clock_offset import ClockFit, ClockOffset
    from coloc_graph.frontend.pairing.correspondence import Correspondences, correspond, pair_by_time
    from coloc_graph.frontend.sighting import sight
    from coloc_graph.frontend.stance import (
        FrontendOptions,
        PairMeasurement,
        Scale,
        little_in_common,
        measure_pair,
        measured_pairs,
    )
    from coloc_graph.frontend.stance_sightings import sight_movers, sight_standing, unsighted_movers
    from coloc_graph.frontend.stance_tracks import StanceTracks
    from coloc_graph.frontend.tracks.track import Track, TrackerOptions
    from coloc_graph.frontend.tracks.tracking import MarkerTracker

__all__ = [
    "Blobs",
    "ClockFit",
    "ClockOffset",
    "Correspondences",
    "Detector",
    "FrontendOptions",
    "HomographyFit",
    "MarkerTracker",
    "PairMeasurement",
    "PointPairs",
    "Scale",
    "SeenLandmarks",
    "StanceTracks",
    "Threshold",
    "Track",
    "TrackerOptions",
    "UnusedSighting",
    "WheelTrack",
    "choose_by_normal",
    "correspond",
    "decompose_svd",
    "decompose_with_normal",
    "describe_unused",
    "detect_hue",
    "detect_leds",
    "detector_for",
    "distance_from_span",
    "fit_homography",
    "least_squares",
    "little_in_common",
    "measure_pair",
    "measured_pairs",
    "metric_scale",
    "most_likely_pose",
    "on_plane",
    "pair_by_time",
    "plane_from_mount",
    "refine",
    "relative_pose",
    "share_clock_offsets",
    "sight",
    "sight_landmarks",
    "sight_movers",
    "sight_standing",
    "unsighted_movers",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "homography.decomposition": "choose_by_normal decompose_svd decompose_with_normal metric_scale",
        "homography.eq2_pose": "relative_pose",
        "homography.fit": "HomographyFit fit_homography",
        "homography.ml_pose": "most_likely_pose",
        "homography.plane": "distance_from_span on_plane plane_from_mount",
        "homography.refinement": "PointPairs least_squares refine",
        "images.detection": "Blobs Detector Threshold detect_hue detect_leds detector_for",
        "landmarks": "UnusedSighting SeenLandmarks describe_unused sight_landmarks",
        "odometry": "WheelTrack",
        "pairing.clock_fusion": "share_clock_offsets",
        "pairing.clock_offset": "ClockFit ClockOffset",
        "pairing.correspondence": "Correspondences correspond pair_by_time",
        "sighting": "sight",
        "stance": "FrontendOptions PairMeasurement Scale little_in_common measure_pair measured_pairs",
        "stance_sightings": "sight_movers sight_standing unsighted_movers",
        "stance_tracks": "StanceTracks",
        "tracks.track": "Track TrackerOptions",
        "tracks.tracking": "MarkerTracker",
    },
)
