"""Writes demonstrations in the layouts of RLBench, PerAct and PerAct2, with pictures of a scene known by formula.

Colour is a function of the place in the world, so whoever reads picture, depth and camera back can tell where each
pixel has to be. Written from the formats alone: no code of the importer is used.
"""

import os
import pickle
import sys
import types
from pathlib import Path

import cv2
import numpy as np

CAMERA = np.array(
    [[0, -0.42261826, -0.90630779, 1.35], [-1, 0, 0, 0], [0, 0.90630779, -0.42261826, 1.58], [0, 0, 0, 1]]
)
NEAR, FAR = 0.01, 4.5
TABLE = 0.752
BOX_LOW, BOX_HIGH = np.array([0.15, -0.1, TABLE]), np.array([0.35, 0.1, 0.9])


def intrinsics(size):
    focal = -0.5 * size / np.tan(np.deg2rad(20))
    return np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])


def render(size):
    """A box on a table: uint8 (H, W, 3) and planar depth (H, W), by intersecting each pixel's ray."""
    v, u = np.mgrid[:size, :size].astype(float)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsics(size)).T @ CAMERA[:3, :3].T
    origin = CAMERA[:3, 3]
    table = np.where(rays[..., 2] < 0, (TABLE - origin[2]) / rays[..., 2], np.inf)
    rays = np.where(rays == 0, 1e-12, rays)
    low, high = (BOX_LOW - origin) / rays, (BOX_HIGH - origin) / rays
    enter, leave = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
    depth = np.minimum(table, np.where((enter < leave) & (enter > 0), enter, np.inf))
    depth = np.where(depth < FAR, depth, FAR)
    return colour_of(origin + rays * depth[..., None]), depth


def colour_of(points):
    """uint8 (..., 3) of world points: each channel rises with one axis, 2 mm a step or less, and wraps around."""
    return (np.rint(np.asarray(points, np.float64) * 500) % 256).astype(np.uint8)


def trajectory(frames=40, arms=1):
    """Poses (T, A, 7), grippers (T, A) and joint velocities (T, A, 7): down to the box, close, up, a pause, open."""
    way = np.linspace(0, 1, frames)
    pose = np.zeros((frames, arms, 7))
    pose[..., 0] = 0.25
    pose[..., 1] = np.linspace(-0.05, 0.05, arms) if arms > 1 else 0.0
    pose[..., 2] = (0.95 + 0.3 * np.abs(1 - 2.5 * way))[:, None]
    pose[..., 4] = 1.0
    gripper = np.ones((frames, arms))
    gripper[int(0.4 * frames) : int(0.8 * frames)] = 0.0
    velocity = np.full((frames, arms, 7), 0.5)
    velocity[int(0.55 * frames) : int(0.6 * frames) + 1] = 0.01
    return pose, gripper, velocity


CLASSES = {
    "rlbench": (),
    "rlbench.backend": (),
    "rlbench.demo": ("Demo",),
    "rlbench.backend.observation": ("Observation", "BimanualObservation", "UnimanualObservationData"),
}


class _Fakes:
    """RLBench's classes under their own names for as long as something is pickled."""

    def __enter__(self):
        self.made = {}
        for module_name, class_names in CLASSES.items():
            module = types.ModuleType(module_name)
            for name in class_names:
                self.made[name] = type(name, (), {"__module__": module_name})
                setattr(module, name, self.made[name])
            sys.modules[module_name] = module
        return self

    def __exit__(self, *_):
        for module_name in CLASSES:
            del sys.modules[module_name]

    def make(self, name, **fields):
        made = self.made[name]()
        made.__dict__.update(fields)
        return made


def save_png(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))


def pack_depth(depth):
    """RLBench's 24 bits in red, green and blue of depth as a share of near to far."""
    count = np.floor((depth - NEAR) / (FAR - NEAR) * (2**24 - 1) + 0.5).astype(np.int64)
    return np.stack([count >> 16, count >> 8 & 255, count & 255], -1).astype(np.uint8)


def write_episode(
    folder: Path,
    arms=1,
    size=32,
    frames=40,
    protocol=4,
    descriptions=("pick up the red box", "lift the red box"),
    cameras=("front",),
    change=None,
    demo_change=None,
):
    """One episode folder, whose cameras are all in one place.

    change(number, fields of each arm, other fields) and demo_change(observations) alter what is pickled.
    """
    pose, gripper, velocity = trajectory(frames, arms)
    rgb, depth = render(size)
    colour, distance = ("rgb_{:04d}.png", "depth_{:04d}.png") if arms == 2 else ("{}.png", "{}.png")
    for i in range(frames):
        for camera in cameras:
            save_png(folder / f"{camera}_rgb" / colour.format(i), rgb)
            save_png(folder / f"{camera}_depth" / distance.format(i), pack_depth(depth))
    with _Fakes() as fakes:
        observations = []
        for i in range(frames):
            felt = [
                {
                    "joint_velocities": velocity[i, arm],
                    "joint_positions": np.zeros(7),
                    "gripper_open": float(gripper[i, arm]),
                    "gripper_pose": pose[i, arm],
                    "ignore_collisions": np.array(1.0),
                }
                for arm in range(arms)
            ]
            rest = {
                "front_rgb": None,
                "task_low_dim_state": np.array([]),
                "misc": {"variation_index": 0},
            }
            for camera in cameras:
                rest["misc"] |= {
                    f"{camera}_camera_extrinsics": CAMERA.copy(),
                    f"{camera}_camera_intrinsics": intrinsics(size),
                    f"{camera}_camera_near": NEAR,
                    f"{camera}_camera_far": np.float64(FAR),
                }
            if change:
                change(i, felt, rest)
            if arms == 2:
                sides = {
                    side: fakes.make("UnimanualObservationData", **f)
                    for side, f in zip(("left", "right"), felt, strict=True)
                }
                observations.append(fakes.make("BimanualObservation", perception_data={}, **sides, **rest))
            else:
                observations.append(fakes.make("Observation", **felt[0], **rest))
        if demo_change:
            observations = demo_change(observations)
        demo = fakes.make("Demo", _observations=observations, random_seed=np.random.RandomState(0).get_state())
        save_pickle(folder / "low_dim_obs.pkl", demo, protocol)
    save_pickle(folder / "variation_descriptions.pkl", list(descriptions), protocol)
    save_pickle(folder / "variation_number.pkl", np.int64(3) if arms == 2 else 3, protocol)


def save_pickle(path, value, protocol=4):
    path.write_bytes(pickle.dumps(value, protocol))


def write_dataset(root: Path, tasks, episodes=2, **options):
    """PerAct's layout; `tasks` are names, and those that start with `bimanual_` get two arms."""
    for task in tasks:
        for number in range(episodes):
            folder = root / task / "all_variations" / "episodes" / f"episode{number}"
            write_episode(folder, arms=2 if task.startswith("bimanual_") else 1, **options)
    return root


class Loud:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)
