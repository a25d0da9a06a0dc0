"""Starts of trials by text.

tabletop:0-9         scenes of the tabletop world, by seed
my_episode           an episode: a folder or a .zip
runs/lerobot:0-4     first frames of episodes of a LeRobot dataset; without numbers, of all
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from egosim_jax.data.readers.lerobot import read_info
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import Backend, neutral_prompt
from egosim_jax.interactive.env.tasks import Condition
from egosim_jax.io.bounded import quote, quote_path
from egosim_jax.simulation.episode import Episode
from egosim_jax.simulation.start import Start
from egosim_jax.types import InputError, VideoSpec, check_seed
from egosim_jax.worlds.tabletop import Script, make_scripts

TABLETOP = "tabletop"
MAX_STARTS = 1000
"""Maximum number of starts that one text may name."""
RANGE = re.compile(r"(\d{1,18})(?:-(\d{1,18}))?")


ReadLeRobot = Callable[[Path, int, VideoSpec], Episode]
"""Function that returns an episode of a LeRobot dataset (`annotate/lerobot_episode.py`)."""


@dataclass(frozen=True, kw_only=True)
class TrialStart:
    """Scene in which trials begin."""

    name: str
    """Name in tables and folders."""
    begin: Callable[[Backend, ActionSpec], Start]
    """Function that returns the start for a policy's actions."""
    seed: int | None = None
    """Seed of a tabletop scene; None for another scene."""

    def script(self, actions: ActionSpec, video: VideoSpec) -> Script | None:
        """Return the script of a tabletop scene, if it brings an object to a place."""
        if self.seed is None:
            return None
        script = next(make_scripts(self.seed, spec=video, kind=actions.kind))
        return None if script.intent.goal_m is None else script

    def loose(self, start: Start, actions: ActionSpec, video: VideoSpec) -> list[str]:
        """Return the names of the objects that can be picked up; of an episode, all objects."""
        if self.seed is None:
            return list(start.state.names.values())
        scene = next(make_scripts(self.seed, spec=video, kind=actions.kind)).scene
        return [body.name for body in scene.bodies if not (body.static or body.articulated)]


def carried(script: Script | None) -> Condition | None:
    """Return the condition that the object of a script is at its goal."""
    if script is None or script.intent.goal_m is None:
        return None
    x, y, z = script.intent.goal_m - script.scene.body(script.intent.name).world_from_body[:3, 3]
    offset_m = float(x), float(y), float(z)
    return Condition(kind="moved to", object=script.intent.name, offset_m=offset_m)


def read_starts(
    texts: Sequence[str], video: VideoSpec, read_lerobot: ReadLeRobot
) -> list[TrialStart]:
    """Return the starts of all texts. Raises `InputError` if one cannot be read, or is repeated."""
    starts = [start for text in texts for start in _read(text, video, read_lerobot)]
    names = [start.name for start in starts]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"The start {quote(twice)} is given twice: give it once. (--starts)")
    return starts


def _read(text: str, video: VideoSpec, read_lerobot: ReadLeRobot) -> Iterator[TrialStart]:
    place, separator, numbers = text.rpartition(":")
    if place == TABLETOP:
        for seed in _numbers(numbers, text):
            check_seed(seed, name="--starts")
            yield TrialStart(name=f"{TABLETOP}:{seed}", begin=partial(_tabletop, seed), seed=seed)
        return
    path, chosen = (Path(place), numbers) if separator and RANGE.fullmatch(numbers) else (text, "")
    path = Path(path)
    if not path.exists():
        raise InputError(
            f"There is no start {quote(text)}: it must be {TABLETOP}:0-9, an episode, or a LeRobot "
            "dataset, with numbers of its episodes as in DATASET:0-4. (--starts)"
        )
    if not (path / "meta" / "info.json").exists():
        yield _of_episode(Episode.load(path), path.name)
        return
    total = read_info(path, ["v3.0"]).get("total_episodes")
    if not isinstance(total, int):
        raise InputError(f"{quote_path(path)} does not say its number of episodes. (--starts)")
    for number in _numbers(chosen, text) if chosen else range(total):
        yield _of_episode(read_lerobot(path, number, video), f"{path.name}:{number}")


def _numbers(text: str, given: str) -> range:
    match = RANGE.fullmatch(text)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
    if not 0 <= last - first < MAX_STARTS:
        raise InputError(
            f"The start {quote(given)} has no numbers: give one, or the first and the last, such "
            f"as 0-9, at most {MAX_STARTS:,}. (--starts)"
        )
    return range(first, last + 1)


def _tabletop(seed: int, backend: Backend, actions: ActionSpec) -> Start:
    return backend.start(seed, actions)


def _of_episode(episode: Episode, name: str) -> TrialStart:
    start = Start.of(episode)

    def begin(backend: Backend, actions: ActionSpec) -> Start:
        # the episode's own prompt says what its recorded hands do, which the policy need not do
        return replace(start, prompt=neutral_prompt(actions))

    return TrialStart(name=name, begin=begin)
