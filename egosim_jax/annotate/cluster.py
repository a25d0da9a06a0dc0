"""Annotation on Ray: two pools of actors run the stages, on this machine or on a cluster.

    ray start --head                                    on one machine of the cluster
    ray start --address=HEAD:6379                       on each other machine
    ray job submit -- egosim data annotate VIDEO ... --out OUT --ray auto --ray-actors 8 4

OUT and the videos must have the same paths on all machines. Rows hold ids and paths: no frame
enters the object store. Actors write finished stages to disk, so a killed run can be resumed, with
or without Ray. A local cluster listens on the loopback device only and sends no usage statistics.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from egosim_jax.annotate import clip
from egosim_jax.annotate.clip import Job
from egosim_jax.annotate.config import AnnotateConfig
from egosim_jax.types import InputError

ADDRESS = "RAY_ADDRESS"
"""Environment variable with the cluster address of a submitted job."""
LOOPBACK = "127.0.0.1"


class Stages:
    """Ray actor that maps rows of clips: the first stages, or the others and the clip's files."""

    def __init__(self, out: str, config: AnnotateConfig, first_only: bool):
        self._settings = Path(out), config, config.build()
        self._first_only = first_only

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Return the row with the clip's status."""
        if row["status"] == "failed":
            return row
        job = Job(**json.loads(row["job"]))
        status = clip.annotate(job, *self._settings, first_only=self._first_only)
        return {**row, "status": status}


def annotate_on_ray(
    jobs: Sequence[Job],
    out: Path,
    config: AnnotateConfig,
    *,
    address: str,
    gpus: tuple[float, float] = (0.0, 0.0),
    actors: tuple[int, int] = (1, 1),
) -> Iterator[str]:
    """Annotate clips by two pools of actors; yield the status of each finished clip.

    `address` is a cluster address, or `auto` for the cluster in RAY_ADDRESS or a new local one.
    """
    if find_spec("ray") is None:
        raise InputError(
            "Ray is not installed: --ray needs it. Run pip install 'egosim-jax[cluster]'."
        )
    out = out.resolve()
    rows = [
        {"video_id": job.video_id, "job": json.dumps(asdict(job)), "status": ""}
        for job in jobs
        if not clip.is_final(job, out)
    ]
    yield from ["done"] * (len(jobs) - len(rows))
    if not rows:
        return
    _connect(address)
    import ray

    try:
        data = ray.data.from_items(rows, override_num_blocks=min(len(rows), 1000))
        for first_only, gpu, max_actors in zip((True, False), gpus, actors, strict=True):
            data = data.map(
                cast(Any, Stages),
                fn_constructor_args=(str(out), config, first_only),
                compute=ray.data.ActorPoolStrategy(min_size=1, max_size=max(1, max_actors)),
                num_gpus=gpu or None,
            )
        for row in data.iter_rows():
            yield row["status"]
    finally:
        ray.shutdown()


def _connect(address: str) -> None:
    """Connect to a cluster, or start one that only this machine can reach."""
    alone = address == "auto" and not os.environ.get(ADDRESS)
    if alone:  # before the import: ray reads these variables when it is imported
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    import ray
    import ray.data

    ray.data.DataContext.get_current().enable_progress_bars = False
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    if not alone:
        ray.init(address=None if address == "auto" else address, log_to_driver=False)
        return
    ray.init(
        address="local", include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
    )
    if (listens := ray.util.get_node_ip_address()) != LOOPBACK:
        ray.shutdown()
        raise InputError(
            f"Ray would listen on {listens}, not only on the loopback device. The cause is this "
            "version of Ray, or an earlier import of Ray. Start a cluster yourself and give its "
            "address. (--ray)"
        )
