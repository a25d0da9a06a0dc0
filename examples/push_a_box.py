"""Make a scene of two boxes, as a depth camera sees it, and a hand that pushes one of them.

Writes what `egosim episode make` reads. World: x right, y away from the wearer, z up, in meters."""

import json
from pathlib import Path

import cv2
import numpy as np
from open3d.t.geometry import RaycastingScene, TriangleMesh

from egosim_jax.worlds.tabletop.hand_motion import Grip

out, boxes = Path("runs/examples/push_a_box"), RaycastingScene()
out.mkdir(parents=True, exist_ok=True)
boxes.add_triangles(TriangleMesh.create_box(1.2, 0.9, 0.1).translate((-0.6, -0.4, -0.1)))  # table
boxes.add_triangles(TriangleMesh.create_box(0.06, 0.06, 0.07).translate((-0.14, 0.02, 0)))
boxes.add_triangles(TriangleMesh.create_box(0.06, 0.06, 0.1).translate((0.06, 0.12, 0)))
intrinsics_px = np.array([[138.6, 0, 79.5], [0, 138.6, 47.5], [0, 0, 1]])
camera = np.array([[1, 0, 0, 0], [0, -0.6, 0.8, -0.45], [0, -0.8, -0.6, 0.36], [0, 0, 0, 1]])
half = [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # Open3D's pixels have their centers at .5
rays = boxes.create_rays_pinhole(intrinsics_px + half, np.linalg.inv(camera), 160, 96)
hit = {name: array.numpy() for name, array in boxes.cast_rays(rays).items()}
colors = np.array([(176, 146, 112), (190, 40, 40), (50, 130, 70)])[hit["geometry_ids"] % 3]
light = 0.6 + np.abs(hit["primitive_normals"]) @ [0.0, 0.1, 0.4]
image = (light[..., None] * colors).astype(np.uint8)
cv2.imwrite(str(out / "scene.png"), image[..., ::-1])
np.savez(out / "depth.npz", depth_m=np.nan_to_num(hit["t_hit"], posinf=0))  # 0: not known

push = [[-0.11, 0.05, 0.035, 0], [-0.11, 0.05, 0.035, 0.3], [0.04, 0.05, 0.035, 0.3]]
leave = [[0.04, 0.05, 0.035, 0.3], [0.04, 0.05, 0.035, 0], [0.1, -0.1, 0.1, 0]]
prompts = "The right hand pushes the red box.", "The right hand moves away."
for number, keys in enumerate([push, leave]):  # at frames 0, 4 and 16: x, y, z, closure
    poses = np.stack([np.interp(np.arange(17), [0, 4, 16], key) for key in np.transpose(keys)], 1)
    grips = [Grip(point_m=row[:3], yaw=0.0, pitch=0.0, closure=row[3]) for row in poses]
    joints = [[grip.pose("human", "right")[0].tolist()] for grip in grips]
    clip = {"world_from_camera": [camera.tolist()] * 17, "intrinsics_px": intrinsics_px.tolist()}
    clip |= {"joints_m": joints, "prompt": prompts[number]}
    print(path := out / f"clip_{number + 1}.json")
    path.write_text(json.dumps(clip))
