"""Vector environments for Stable-Baselines3, whose algorithms reset ended episodes at once.

    model = PPO("MlpPolicy", StableBaselinesEnv(envs))

`VecMonitor` around it counts returns and lengths. Needs the extra `rl`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from jaxtyping import Bool, Float, Float32
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from egosim_jax.types import InputError

SPACES = spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary
"""Spaces that Stable-Baselines3 takes, alone or as values of one dictionary."""
Results = tuple[Any, Float32[np.ndarray, " n"], Bool[np.ndarray, " n"], list[dict[str, Any]]]


class StableBaselinesEnv(VecEnv):
    """A Gymnasium vector environment that never resets by itself, as a `VecEnv`."""

    def __init__(self, envs: VectorEnv):
        if envs.metadata.get("autoreset_mode") != AutoresetMode.DISABLED:
            raise InputError(
                f"The environment resets by itself ({envs.metadata.get('autoreset_mode')}): give "
                "one of this package, which is reset by reset_mask. (envs)"
            )
        _check_spaces(envs.single_observation_space)
        self.envs, self._actions = envs, np.zeros(0)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Begin all episodes, by the seeds of `seed`, and return the observations."""
        given = [seed for seed in self._seeds if seed is not None]
        seen, info = self.envs.reset(seed=self._seeds if given else None)  # type: ignore[arg-type]
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = _split(info, self.num_envs)
        return seen

    def step_async(self, actions: Float[np.ndarray, "n a"]) -> None:
        """Keep the actions until `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Results:
        """Step all episodes as one batch, and begin the ended ones again.

        `infos` has the last observation of an ended episode, as Stable-Baselines3 expects it.
        """
        seen, rewards, terminated, truncated, info = self.envs.step(self._actions)
        done, infos = terminated | truncated, _split(info, self.num_envs)
        for number in np.flatnonzero(done).tolist():
            infos[number]["terminal_observation"] = _of(seen, number)
            infos[number]["TimeLimit.truncated"] = bool(truncated[number])
        if done.any():
            seen, info = self.envs.reset(options={"reset_mask": done})
            for number, first in enumerate(_split(info, self.num_envs)):
                if done[number]:
                    self.reset_infos[number] = first
        return seen, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each episode."""
        return [getattr(self.envs, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment, which all episodes share."""
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **options: Any
    ) -> list[Any]:
        """Call a method of the vector environment once, for all episodes."""
        return [getattr(self.envs, method_name)(*args, **options)] * len(self._indices(indices))

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each episode: they have no wrappers."""
        return [False] * len(self._indices(indices))

    def _indices(self, indices: VecEnvIndices) -> Sequence[int]:
        return list(self._get_indices(indices))


def _check_spaces(space: spaces.Space) -> None:
    """Raise `InputError` for an observation that Stable-Baselines3 cannot take."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    for name, part in parts.items():
        if not isinstance(part, SPACES):
            raise InputError(
                f"The observation {name!r} is a {type(part).__name__}: Stable-Baselines3 takes no "
                "nested ones. Observe frames, depth or keypoints, or use a skill. (observe)"
            )


def _of(seen: Any, number: int) -> Any:
    """Return the observation of one episode."""
    if isinstance(seen, dict):
        return {name: values[number] for name, values in seen.items()}
    return seen[number]


def _split(info: dict[Any, Any], count: int) -> list[dict[Any, Any]]:
    """Return the information of each episode: the values of a key that it has."""
    infos: list[dict[Any, Any]] = [{} for _ in range(count)]
    for name, values in info.items():
        if str(name).startswith("_") and name[1:] in map(str, info):
            continue
        present = info.get(f"_{name}", np.ones(count, bool))
        inner = _split(values, count) if isinstance(values, dict) else values
        for number in np.flatnonzero(present).tolist():
            infos[number][name] = inner[number]
    return infos
