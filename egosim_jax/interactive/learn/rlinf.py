"""Environment for RLinf, with the interface of its world-model environments.

RLinf loads the module that `RLINF_EXT_MODULE` names, here this one, and calls `register`. Then an
environment config with `simulator: egosim_jax` is of this class:

    env_type: embodichain      # a type whose actions RLinf passes on as they are
    simulator: egosim_jax
    world: generated           # or true
    reward: my_package:judge   # MODULE:NAME of a reward, with its options
    first_scene: 1000
    scenes: 200
    max_episode_steps: 64      # rows; a clip has `num_action_chunks`

Actions are rows (`action_spec.py`), cut off at their bounds. RLinf itself is not imported, but for
`register`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from egosim_jax.interactive.env import load_backend, make_vec
from egosim_jax.interactive.env.rewards import Outcome, Reward, RewardFn, judge, reward_of
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import torch

NAME = "egosim_jax"
"""Value of `simulator` in the config of an environment."""
MAX_CHUNKS = 10**6
"""Clips of an episode below, which this environment ends by `max_episode_steps`."""


@dataclass(frozen=True)
class _Endless:
    """Reward that never ends an episode: RLinf decides when one is reset."""

    reward: RewardFn

    def check(self, start: Any) -> None:
        """Refuse what the reward refuses."""
        if (check := getattr(self.reward, "check", None)) is not None:
            check(start)

    def __call__(self, outcome: Outcome) -> Reward:
        return replace(judge(self.reward, outcome), terminated=False)


class RLinfEnv:
    """Episodes that are stepped by chunks of rows; success terminates, and the rest is truncated.

    With `group_size`, consecutive episodes share a scene. With `auto_reset`, ended episodes begin
    in new scenes at once, and `infos` has the last observations.
    """

    def __init__(
        self,
        cfg: Mapping[str, Any],
        num_envs: int,
        seed_offset: int,
        total_num_processes: int,
        worker_info: Any = None,
        record_metrics: bool = True,
    ):
        self.cfg, self.num_envs, self.record_metrics = cfg, num_envs, record_metrics
        self.video_cfg = cfg.get("video_cfg")
        self.auto_reset = bool(cfg.get("auto_reset", True))
        self.ignore_terminations = bool(cfg.get("ignore_terminations", False))
        self.group_size = int(cfg.get("group_size", 1))
        import torch

        if num_envs % self.group_size:
            raise InputError(
                f"{num_envs} episodes are no multiple of {self.group_size}: change total_num_envs "
                "or group_size. (group_size)"
            )
        self._fixed = bool(cfg.get("use_fixed_reset_state_ids", False))
        self._rng = np.random.default_rng(int(cfg.get("seed", 0)) + seed_offset)
        first = int(cfg.get("first_scene", 0))
        self._scenes = np.arange(first, first + int(cfg.get("scenes", 1000)))
        backend = load_backend(
            cfg.get("world", "generated"), config=cfg.get("config"), batch=num_envs
        )
        reward = _Endless(reward_of(str(cfg["reward"])))
        self.envs = make_vec(
            num_envs=num_envs, backend=backend, reward=reward, max_chunks=MAX_CHUNKS
        )
        self.chunk = self.envs.chunk
        self.is_start, self.elapsed_steps = True, torch.zeros(num_envs, dtype=torch.long)
        self.success_once = torch.zeros(num_envs, dtype=torch.bool)
        self.returns = torch.zeros(num_envs)
        self.update_reset_state_ids()

    @property
    def info_logging_keys(self) -> list[str]:
        """Keys of `infos` that RLinf logs besides the episode's."""
        return []

    def update_reset_state_ids(self) -> None:
        """Draw the scenes of the next reset, one for each group."""
        groups = self.num_envs // self.group_size
        self.reset_state_ids = self._rng.choice(self._scenes, groups).repeat(self.group_size)

    def reset(
        self,
        *,
        seed: Any = None,
        options: Mapping[str, Any] | None = None,
        env_idx: Sequence[int] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin all episodes, or some, in drawn scenes; fixed scenes stay."""
        import torch

        if not (self.is_start or self._fixed):
            self.update_reset_state_ids()
        self.is_start = False
        mask = np.ones(self.num_envs, bool)
        if env_idx is not None:
            mask = np.isin(np.arange(self.num_envs), np.asarray(env_idx))
        seen, _ = self.envs.reset(seed=self.reset_state_ids.tolist(), options={"reset_mask": mask})
        for values in (self.elapsed_steps, self.success_once, self.returns):
            values[torch.as_tensor(mask)] = 0
        return self._observation(seen), {}

    def step(self, actions: Any = None, auto_reset: bool = True) -> None:
        """Refuse: as in RLinf's world-model environments, only chunks are stepped."""
        raise NotImplementedError("A world model is stepped by chunk_step.")

    def chunk_step(
        self, actions: torch.Tensor | np.ndarray
    ) -> tuple[
        list[dict[str, Any]], torch.Tensor, torch.Tensor, torch.Tensor, list[dict[str, Any]]
    ]:
        """Simulate the rows of all episodes, of shape (episodes, rows, numbers), as one batch.

        Reward, termination and truncation are of the clip, at its last row.
        """
        import torch

        rows = np.clip(np.asarray(actions, float), *self.envs.actions.bounds)
        seen, reward, _, _, info = self.envs.chunk_step(rows)
        self.elapsed_steps += rows.shape[1]
        success = torch.as_tensor(info["success"].astype(bool))
        observation, infos = self._observation(seen), self._record(reward, success)
        ended = success & (not self.ignore_terminations)
        truncated = (self.elapsed_steps >= int(self.cfg["max_episode_steps"])) & ~ended
        done = ended | truncated
        if self.auto_reset and done.any():
            last, of_last = observation, infos
            observation, _ = self.reset(env_idx=np.flatnonzero(done.numpy()).tolist())
            infos = {
                **infos,
                "final_observation": last,
                "final_info": of_last,
                "_final_observation": done,
                "_final_info": done,
                "_elapsed_steps": done,
            }
        zero = torch.zeros(rows.shape[:2])
        ends = [_at_the_end(zero, values) for values in (torch.as_tensor(reward), ended, truncated)]
        return [observation], ends[0], ends[1].bool(), ends[2].bool(), [infos]

    def _record(self, reward: np.ndarray, success: torch.Tensor) -> dict[str, Any]:
        """Return the metrics of the episodes so far."""
        import torch

        if not self.record_metrics:
            return {}
        self.returns += torch.as_tensor(reward, dtype=torch.float32)
        self.success_once |= success
        length = self.elapsed_steps.float()
        episode = {
            "success_once": self.success_once.clone(),
            "return": self.returns.clone(),
            "episode_len": length,
            "reward": self.returns / length.clamp(min=1),
        }
        return {"episode": episode}

    def _observation(self, seen: dict[str, Any]) -> dict[str, Any]:
        import torch

        return {
            "main_images": torch.as_tensor(seen["frames"][:, -1]),
            "wrist_images": None,
            "states": torch.as_tensor(seen["row"], dtype=torch.float32),
            "task_descriptions": [running.now.prompt for running in self.envs.running],
        }

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()


def _at_the_end(zero: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Return the values of a chunk's last row, and 0 before it."""
    filled = zero.clone()
    filled[:, -1] = values.float()
    return filled


def register() -> None:
    """Give RLinf this class for configs with `simulator: egosim_jax`."""
    import rlinf.envs  # pyright: ignore[reportMissingImports]
    from rlinf.workers.env import env_worker  # pyright: ignore[reportMissingImports]

    of_rlinf = rlinf.envs.get_env_cls

    def get_env_cls(env_type: str, env_cfg: Any = None, *args: Any, **options: Any) -> type:
        if env_cfg is not None and env_cfg.get("simulator") == NAME:
            return RLinfEnv
        return of_rlinf(env_type, env_cfg, *args, **options)

    rlinf.envs.get_env_cls = env_worker.get_env_cls = get_env_cls
