"""Simulation of a task in MuJoCo, and its video, depth and ids by MuJoCo's ray caster.

Objects are free bodies with contacts. The gripper follows a script: three mocap bodies (palm and
two jaws) and a forearm. A weld holds the object while the jaws are closed on it; a push is contact
alone. Images need no OpenGL: `mj_multiRay` finds what a pixel sees, and what the lamp sees.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from egosim_jax.geometry import invert, look_at, pixel_rays
from egosim_jax.types import Action, Cameras, Clip
from tests.mujoco_world.solids import SHAPES, Part, Texture
from tests.mujoco_world.tasks import Layout, make_layout

FPS, STEPS = 8, 50
"""Frames per second, and steps of physics per frame."""
HEIGHT, WIDTH, FOCAL = 120, 208, 180.0
EYE_M, TARGET_M = np.array([0.0, -0.38, 0.45]), np.array([0.0, 0.05, 0.0])
LAMP_M = np.array([-0.5, -0.3, 1.3])
AMBIENT, DIFFUSE = 0.45, 0.65
FINGER_M, OPEN_M, SQUEEZE_M = 0.12, 0.10, 0.001
"""Wrist to fingertips, largest opening, and by how much the jaws close more than they measure."""
DOWN, DOWN_PUSH = np.radians([28, 8])
"""Angle of the fingers below the horizon, and in a push, which would press the object down."""
JAW_M = (0.005, 0.04, 0.008)
PALM_M = (0.035, 0.02, 0.015)
"""Half sizes of a jaw and of the palm: along the opening, along the finger, across both."""
SCENERY, GRIPPER, OTHERS, TARGET, UNSEEN = range(5)
"""MuJoCo's groups of geometries."""
GRIPPER_COLORS = {"palm": (70, 75, 85), "left": (40, 40, 44), "right": (40, 40, 44)}
WOOD = Texture(colors=((186, 140, 98), (140, 98, 62)), pattern="grain", period_m=0.012)
FLOOR = Texture(colors=((90, 96, 104), (110, 116, 122)), pattern="checks", period_m=0.6)


@dataclass(frozen=True, kw_only=True)
class Film:
    """A scene and what the gripper does in it; the world's frame is the first camera's."""

    layout: Layout
    clip: Clip
    action: Action
    scene: np.ndarray
    """The first image without the gripper, and its depth and ids."""
    depth_m: np.ndarray
    ids: np.ndarray
    names: dict[int, str]
    motions: dict[int, np.ndarray]
    """Motion of each object relative to frame 0."""
    target_id: int = 1


def make_film(seed: int) -> Film:
    """Simulate the task of a seed and render it."""
    layout = make_layout(seed)
    model, textures = _build(layout)
    data = mujoco.MjData(model)
    cameras = _cameras(layout.task.frames, np.random.default_rng([seed, 1]))
    script = _Script(model, data, layout)
    origin = invert(cameras.world_from_camera[0])
    frames, joints, poses = [], [], []
    scene = depth = ids = np.zeros(0)
    for frame in range(layout.task.frames):
        joints.append(script.advance(frame))
        camera = cameras.world_from_camera[frame]
        if frame == 0:
            scene, depth, ids = render(model, data, camera, textures, gripper=False)
        frames.append(render(model, data, camera, textures)[0])
        poses.append([_pose(data, 1 + n) for n in range(len(layout.placed))])
    path = np.array(poses)
    return Film(
        layout=layout,
        clip=Clip(frames=np.array(frames), fps=FPS),
        action=Action(
            cameras=_relative(cameras, origin),
            joints_m=np.array(joints)[:, None] @ origin[:3, :3].T + origin[:3, 3],
            kind="robot",
            prompt="The gripper moves something.",
        ),
        scene=scene,
        depth_m=depth,
        ids=ids,
        names={n + 1: p.name for n, p in enumerate(layout.placed)},
        motions={
            n + 1: origin @ path[:, n] @ invert(path[0, n]) @ invert(origin)
            for n in range(len(layout.placed))
        },
    )


def render(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    world_from_camera: np.ndarray,
    textures: list[Texture],
    *,
    gripper: bool = True,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the image, with two rays a pixel, and depth and ids, by the ray of its center."""
    offsets = ((0.0, 0.0), (-0.25, 0.25), (0.25, -0.25))
    groups = np.array([1, gripper, 1, 1, 0, 0], np.uint8)
    rays = np.concatenate(
        [pixel_rays(_intrinsics(*o), height=HEIGHT, width=WIDTH).reshape(-1, 3) for o in offsets]
    )
    eye, length = world_from_camera[:3, 3], np.linalg.norm(rays, axis=1)
    directions = (rays / length[:, None]) @ world_from_camera[:3, :3].T
    geom, distance, normal = _cast(model, data, eye, directions, groups)
    points = eye + distance[:, None] * directions
    normal *= -np.sign((normal * directions).sum(axis=1, keepdims=True))
    to_lamp = LAMP_M - points
    reach = np.linalg.norm(to_lamp, axis=1)
    to_lamp /= reach[:, None]
    _, lit, _ = _cast(model, data, LAMP_M, -to_lamp, groups)
    light = np.where(lit > reach - 1e-3, np.maximum((normal * to_lamp).sum(axis=1), 0), 0)
    body = model.geom_bodyid[geom]
    colors = np.zeros((len(geom), 3))
    for number in np.unique(body):
        own = body == number
        local = (points[own] - data.xpos[number]) @ data.xmat[number].reshape(3, 3)
        colors[own] = textures[number](local)
    colors *= AMBIENT + DIFFUSE * light[:, None]
    shape = len(offsets), HEIGHT, WIDTH
    image = np.rint(255 * np.clip(colors, 0, 1).reshape(*shape, 3)[1:].mean(axis=0))
    depth = (distance / length).reshape(shape)[0].astype(np.float32)
    group = model.geom_group[geom]
    ids = np.where(group >= OTHERS, body, 0).reshape(shape)[0].astype(np.int32)
    return image.astype(np.uint8), depth, ids


def _cast(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    origin: np.ndarray,
    directions: np.ndarray,
    groups: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return geometry, distance and normal where rays of unit length hit."""
    count = len(directions)
    geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
    mujoco.mj_multiRay(
        model, data, origin, directions.ravel(), groups, True, -1, geom, distance, normal, count,
        mujoco.mjMAXVAL,
    )  # fmt: skip
    return geom, distance, normal.reshape(-1, 3)


def _build(layout: Layout) -> tuple[mujoco.MjModel, list[Texture]]:
    """Return the model, and a texture for each body: scenery, objects, gripper."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 1 / (FPS * STEPS)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    textures = [WOOD]
    for number, placed in enumerate(layout.placed):
        body = spec.worldbody.add_body(
            name=f"object {number}", pos=placed.place_m + [0, 0, 1e-4], quat=_about_z(placed.yaw)
        )
        body.add_freejoint()
        for index, part in enumerate(placed.solid.parts):
            _add_part(spec, body, part, f"{number}.{index}", TARGET if number == 0 else OTHERS)
        textures.append(placed.texture)
    _add_gripper(spec, textures, pushes=layout.task.deed == "push")
    _add_scenery(spec, textures)
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.name1, weld.name2, weld.active = "palm", "object 0", False
    weld.solref = [0.01, 1, *weld.solref[2:]]
    return spec.compile(), textures


def _add_gripper(spec: mujoco.MjSpec, textures: list[Texture], *, pushes: bool) -> None:
    """Add palm, jaws and forearm. Nothing touches them but, in a push, a tip of both jaws."""
    untouched = {"group": GRIPPER, "contype": 0, "conaffinity": 0}
    for name, half in (("palm", PALM_M), ("left", JAW_M), ("right", JAW_M)):
        body = spec.worldbody.add_body(name=name, mocap=True)
        body.add_geom(type=SHAPES["box"], size=half, **untouched)
        if pushes and name == "palm":
            place = (0, FINGER_M - PALM_M[1], 0)
            body.add_geom(type=SHAPES["sphere"], size=(0.011, 0, 0), pos=place, group=UNSEEN)
        textures.append(Texture(colors=(GRIPPER_COLORS[name],) * 2))
    arm = spec.worldbody.add_body(name="arm", mocap=True)
    arm.add_geom(type=SHAPES["capsule"], size=(0.024, 0.2, 0), **untouched)
    textures.append(Texture(colors=((190, 190, 195), (150, 150, 160))))


def _add_scenery(spec: mujoco.MjSpec, textures: list[Texture]) -> None:
    """Add a table whose top is at z = 0, in the world's body, and a room around it."""
    spec.worldbody.add_geom(
        type=SHAPES["box"], size=(0.6, 0.4, 0.02), pos=(0, 0.1, -0.02), friction=(0.6, 0.01, 0.001)
    )
    room = spec.worldbody.add_body(name="room")
    for size, place in (
        ((3, 3, 0.05), (0, 0, -0.8)), ((3, 0.05, 3), (0, 2, 0)), ((3, 0.05, 3), (0, -2, 0)),
        ((0.05, 3, 3), (2, 0, 0)), ((0.05, 3, 3), (-2, 0, 0)),
    ):  # fmt: skip
        room.add_geom(type=SHAPES["box"], size=size, pos=place)
    textures.append(FLOOR)


def _add_part(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: Part, name: str, group: int) -> None:
    geom = body.add_geom(type=SHAPES[part.shape], pos=part.center_m, quat=part.turn, group=group)
    geom.friction, geom.condim, geom.density = [0.6, 0.01, 0.002], 6, 400
    if part.mesh is None:
        geom.size[: len(part.size_m)] = part.size_m
        return
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    mesh.uservert = part.mesh.vertices_m.ravel()
    mesh.userface = part.mesh.faces.ravel()
    geom.meshname = name


class _Script:
    """Physics with a gripper that follows a script, frame by frame."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, layout: Layout) -> None:
        self.model, self.data, self.layout = model, data, layout
        self.mocap = [model.body(n).mocapid[0] for n in ("palm", "left", "right", "arm")]
        self.held, self.down = False, DOWN_PUSH if layout.task.deed == "push" else DOWN
        data.mocap_pos[:] = [0, -2, 1]
        for _ in range(8 * STEPS):  # the objects settle
            mujoco.mj_step(model, data)
        self.knots = _push(layout) if layout.task.deed == "push" else self._carry()

    def _carry(self) -> dict[str, np.ndarray]:
        """Return times, pinch points, turns and openings of a carry."""
        data, placed, task = self.data, self.layout.placed[0], self.layout.task
        start = data.body("object 0").xpos + [0, 0, _grip_height(placed.solid.height_m)]
        shift = self.layout.goal_m - placed.place_m
        across = np.array([np.cos(placed.yaw), np.sin(placed.yaw), 0])
        width = self._width(start, across) - SQUEEZE_M
        back = -0.06 * _along(placed.yaw, self.down)
        up, end = np.array([0, 0, 0.07 + shift[2] * (shift[2] > 0)]), start + shift
        retreat = -0.07 * _along(self.layout.goal_yaw, self.down)
        times = [0, 0.18, 0.25, 0.32, 0.45, 0.65, 0.78, 0.82, 0.88, 1]
        points = [start + back, start, start, start, start + up, end + [0, 0, up[2]], end, end, end]
        points.append(end + retreat)
        openings = [OPEN_M, OPEN_M, width, width, width, width, width, width, OPEN_M, OPEN_M]
        if task.deed == "hold":
            points[6:], openings[6:] = [end + [0, 0, up[2]]] * 4, [width] * 4
        turns = [placed.yaw] * 5 + [self.layout.goal_yaw] * 5
        return {
            "time": np.array(times),
            "pinch": np.array(points),
            "yaw": np.array(turns),
            "opening": np.array(openings),
            "grasp": np.array([0.25, 2.0 if task.deed == "hold" else 0.82]),
        }

    def _width(self, pinch: np.ndarray, across: np.ndarray) -> float:
        """Return the width of the target along a line through the pinch point."""
        groups = np.zeros(6, np.uint8)
        groups[TARGET] = 1
        gaps = []
        for side in (-1, 1):
            geom = np.zeros(1, np.int32)
            far = pinch + side * 0.2 * across
            hit = mujoco.mj_ray(self.model, self.data, far, -side * across, groups, True, -1, geom)
            assert hit >= 0, f"the jaws miss the {self.layout.task.solid}"
            gaps.append(0.2 - hit)
        return 2 * max(gaps)

    def advance(self, frame: int) -> np.ndarray:
        """Simulate up to a frame and return the joints: wrist and both tips."""
        last = self.layout.task.frames - 1
        moments = [0.0] if frame == 0 else frame - 1 + np.arange(1, STEPS + 1) / STEPS
        joints = np.zeros((3, 3))
        for moment in moments:
            joints = self._pose(float(moment) / last)
            if frame:
                mujoco.mj_step(self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)
        return joints

    def _pose(self, time: float) -> np.ndarray:
        """Move the gripper, and grasp or release."""
        pinch, yaw, opening = (
            _between(self.knots["time"], self.knots[name], time)
            for name in ("pinch", "yaw", "opening")
        )
        along, across = _along(yaw, self.down), np.array([np.cos(yaw), np.sin(yaw), 0])
        turn = np.stack([across, along, np.cross(across, along)], axis=1)
        wrist = pinch - FINGER_M * along
        tips = [pinch - opening / 2 * across, pinch + opening / 2 * across]
        elbow = np.array([0.6 * wrist[0] + 0.1, -0.5, 0.15])
        reach = (elbow - wrist) / np.linalg.norm(elbow - wrist)
        aside = np.cross(reach, [1.0, 0, 0])
        aside /= np.linalg.norm(aside)
        arm = np.stack([np.cross(aside, reach), aside, reach], axis=1)
        places = [wrist + PALM_M[1] * along]
        for tip, side in zip(tips, (-1, 1), strict=True):
            places.append(tip + side * JAW_M[0] * across - (JAW_M[1] - 0.006) * along)
        places.append(wrist + 0.2 * reach)
        for slot, place, rotation in zip(self.mocap, places, [turn] * 3 + [arm], strict=True):
            self.data.mocap_pos[slot] = place
            mujoco.mju_mat2Quat(self.data.mocap_quat[slot], rotation.ravel())
        begin, end = self.knots["grasp"]
        if not self.held and begin <= time < end:
            mujoco.mj_kinematics(self.model, self.data)
            relative = invert(_pose(self.data, self.model.body("palm").id)) @ _pose(self.data, 1)
            self.model.eq_data[0, :3] = 0
            self.model.eq_data[0, 3:6] = relative[:3, 3]
            mujoco.mju_mat2Quat(self.model.eq_data[0, 6:10], relative[:3, :3].ravel())
            self.data.eq_active[0] = self.held = True
        elif self.held and time >= end:
            self.data.eq_active[0] = self.held = False
        return np.array([wrist, *tips])


def _push(layout: Layout) -> dict[str, np.ndarray]:
    """Return times, pinch points, turns and openings of a push with closed jaws."""
    placed = layout.placed[0]
    ahead = (layout.goal_m - placed.place_m) * [1, 1, 0]
    ahead /= np.linalg.norm(ahead)
    height = np.array([0, 0, min(0.03, 0.5 * placed.solid.height_m)])
    touch = placed.place_m + height - (placed.solid.half_depth_m + 0.02) * ahead
    end = touch + (layout.goal_m - placed.place_m)
    points = [touch - 0.03 * ahead + [0, 0, 0.05], touch - 0.01 * ahead, end, end - 0.06 * ahead]
    return {
        "time": np.array([0, 0.2, 0.75, 1]),
        "pinch": np.array([*points[:3], points[3] + [0, 0, 0.04]]),
        "yaw": np.full(4, placed.yaw),
        "opening": np.full(4, 0.012),
        "grasp": np.array([2.0, 2.0]),
    }


def _grip_height(height_m: float) -> float:
    """Return the height of the pinch point above the object's base."""
    return max(0.5 * height_m, min(0.65 * height_m, height_m - 0.02))


def _between(times: np.ndarray, values: np.ndarray, time: float) -> np.ndarray:
    """Interpolate with rest at every knot."""
    index = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
    share = np.clip((time - times[index]) / (times[index + 1] - times[index]), 0, 1)
    share = share * share * (3 - 2 * share)
    return values[index] + share * (values[index + 1] - values[index])


def _along(yaw: float, down: float) -> np.ndarray:
    """Return the direction of the fingers."""
    level = np.array([-np.sin(yaw), np.cos(yaw), 0])
    return np.cos(down) * level - [0, 0, np.sin(down)]


def _about_z(yaw: float) -> np.ndarray:
    return np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])


def _pose(data: mujoco.MjData, body: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return pose


def _intrinsics(column: float = 0.0, row: float = 0.0) -> np.ndarray:
    """Return the intrinsics of an image that is shifted by a part of a pixel."""
    u, v = (WIDTH - 1) / 2 - column, (HEIGHT - 1) / 2 - row
    return np.array([[FOCAL, 0, u], [0, FOCAL, v], [0, 0, 1]])


def _cameras(frames: int, rng: np.random.Generator) -> Cameras:
    """Return a head that moves by about a centimeter and a degree."""
    time = np.linspace(0, 1, frames)[:, None]
    phase, speed = rng.uniform(0, 2 * np.pi, (2, 1, 6)), rng.uniform(2, 5, (2, 1, 6))
    sway = 0.01 * np.sin(speed * time + phase).sum(axis=0)
    poses = [look_at(EYE_M + s[:3], TARGET_M + s[3:], up=np.array([0, 0, 1.0])) for s in sway]
    return Cameras(
        world_from_camera=np.array(poses), intrinsics_px=_intrinsics(), height=HEIGHT, width=WIDTH
    )


def _relative(cameras: Cameras, origin: np.ndarray) -> Cameras:
    return Cameras(
        world_from_camera=origin @ cameras.world_from_camera,
        intrinsics_px=cameras.intrinsics_px,
        height=HEIGHT,
        width=WIDTH,
    )
