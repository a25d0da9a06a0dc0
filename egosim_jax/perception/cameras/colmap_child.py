"""Structure from motion by pycolmap, run as a program: `python -P colmap_child.py JOB.json`.

pycolmap and OpenCV crash in one process, so this file is run by its path, imports nothing of the
package and never OpenCV. `colmap.py` prepares the images, starts it and reads what it writes.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any


def main(path: Path) -> None:
    """Run the step that a job describes."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job = json.loads(path.read_text())
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    pycolmap.set_random_seed(job["seed"])
    {"features": _features, "incremental": _map, "global": _map}[job["step"]](pycolmap, job)


def _end_with_parent() -> None:
    """End the process when its standard input is closed, as the end of its parent does."""
    while os.read(0, 1):
        pass
    os._exit(1)


def _features(pycolmap: Any, job: dict[str, Any]) -> None:
    """Extract SIFT features of all images and match those that are near in time."""
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", mask_path=job["masks"])
    reader.default_focal_length_factor = job["focal_factor"]
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], use_gpu=False)
    extraction.sift.max_num_features = job["features"]
    extraction.sift.peak_threshold = job["peak_threshold"]
    pycolmap.extract_features(
        job["database"], job["images"], camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader, extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip
    matching = pycolmap.FeatureMatchingOptions(num_threads=job["threads"], use_gpu=False)
    pairing = pycolmap.SequentialPairingOptions(overlap=job["overlap"], num_threads=job["threads"])
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    pycolmap.match_sequential(
        job["database"], matching_options=matching, pairing_options=pairing,
        verification_options=verification, device=pycolmap.Device.cpu,
    )  # fmt: skip


def _map(pycolmap: Any, job: dict[str, Any]) -> None:
    """Reconstruct cameras and points from the matches; keep the model with most images."""
    if job["focal_px"] is not None:
        _set_focal(pycolmap, job)
    free = job["focal_px"] is None
    output = Path(job["output"])
    if job["step"] == "incremental":
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=job["threads"], random_seed=job["seed"], extract_colors=False,
            ba_refine_focal_length=free,
        )  # fmt: skip
        options.mapper.init_min_tri_angle = job["init_angle_deg"]
        options.mapper.init_min_num_inliers = job["init_inliers"]
        options.mapper.abs_pose_refine_focal_length = free
        models = pycolmap.incremental_mapping(
            job["database"], job["images"], output, options=options
        )
    else:
        options = pycolmap.GlobalPipelineOptions(
            num_threads=job["threads"], random_seed=job["seed"]
        )
        options.mapper.bundle_adjustment.refine_focal_length = free
        models = pycolmap.global_mapping(job["database"], job["images"], output, options=options)
    _write(max(models.values(), key=lambda m: m.num_reg_images(), default=None), job)


def _set_focal(pycolmap: Any, job: dict[str, Any]) -> None:
    with pycolmap.Database.open(job["database"]) as database:
        for camera in database.read_all_cameras():
            camera.params = [job["focal_px"], *list(camera.params)[1:3], 0.0]
            camera.has_prior_focal_length = True
            database.update_camera(camera)


def _write(model: Any, job: dict[str, Any]) -> None:
    """Write cameras, points and observations as arrays; empty ones if there is no model."""
    import numpy as np

    images, points, camera = [], [], np.zeros(4)
    if model is not None:
        images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
        points = list(model.points3D.items())
        camera = next(iter(model.cameras.values())).params
    index = {number: n for n, (number, _) in enumerate(points)}
    seen = [
        (int(Path(image.name).stem), index[p.point3D_id], *p.xy)
        for image in images
        for p in image.points2D
        if p.has_point3D()
    ]
    np.savez(
        job["result"],
        frames=np.array([int(Path(i.name).stem) for i in images], np.int32),
        camera_from_world=np.array([i.cam_from_world().matrix() for i in images]).reshape(-1, 3, 4),
        camera=np.asarray(camera, float),
        points=np.array([p.xyz for _, p in points], float).reshape(-1, 3),
        error_px=np.array([p.error for _, p in points], float),
        observations=np.array(seen, float).reshape(-1, 4),
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
