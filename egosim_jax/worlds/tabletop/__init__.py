"""The tabletop world: a table with a few objects, and hands or a gripper that manipulate one.

Its scenes, hands, physics, renderings and datasets belong here. All ground truth is exact: frames
are ray cast, and joints, poses, depth and ids come from the same geometry.

Sequences of a seed (`sequence`)
    make_sequence: rendered clips with ground truth; make_scripts: the same clips, not rendered;
    Script: one of them; start_of_sequence: first scene, camera, frame and state;
    episode_of_sequence: the actions, without ground truth
Any action (`world`)
    World: executes actions
Scenes (`scene`, `scene_spec`)
    Scene: all bodies and their poses; sample_scene: a random one; Object, make_scene: your own;
    read_scene, write_scene: scenes as JSON
Clips (`clips`)
    TabletopClip: clip with ground truth; to_triplet, to_action, to_episode, observation_of:
    conversions; state_after: a state moved by the ground-truth motion

Other modules: `dataset` makes shards; `attempts` makes clips in which hands may fail, `encounters`
those in which they push, slip, hurry or are two; `policies` has policies with faults; `hand_motion`
plans hands; `contact`, `pushes` and `support` move bodies; `bodies`, `hands` and `solids` have the
geometry; `raycast` renders.
"""

from egosim_jax.worlds.tabletop.clips import (
    TabletopClip,
    ground_truth_of,
    observation_of,
    state_after,
    to_action,
    to_episode,
    to_triplet,
)
from egosim_jax.worlds.tabletop.scene import Scene, sample_scene
from egosim_jax.worlds.tabletop.scene_spec import Object, make_scene, read_scene, write_scene
from egosim_jax.worlds.tabletop.sequence import (
    Script,
    episode_of_sequence,
    make_scripts,
    make_sequence,
    start_of_sequence,
)
from egosim_jax.worlds.tabletop.world import World

__all__ = [
    "Object",
    "Scene",
    "Script",
    "TabletopClip",
    "World",
    "episode_of_sequence",
    "ground_truth_of",
    "make_scene",
    "make_scripts",
    "make_sequence",
    "observation_of",
    "read_scene",
    "sample_scene",
    "start_of_sequence",
    "state_after",
    "to_action",
    "to_episode",
    "to_triplet",
    "write_scene",
]
