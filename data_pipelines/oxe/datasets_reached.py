"""Datasets of Open X-Embodiment that others converted to RLDS, of whose actions it is unclear what they are.

Each dataset's page of https://www.tensorflow.org/datasets/catalog leaves open whether its action is a pose or a
displacement: the action is left out, and displacements come from reached poses. What the pages do not say is from
octo's and openvla's ``oxe/transforms`` and from those whom the notes name.
"""

from data_pipelines.oxe.dataset import OxeDataset, View
from data_pipelines.oxe.datasets_converted import IMAGE, OPENING_DOUBTED, SUFFIX, closing, converted, opening
from data_pipelines.oxe.motion import Arm, Column, RotationKind, following, openness, pose, read

_UNCLEAR = "whether the action is a pose or a displacement is unclear: displacements come from reached poses"
_ZXY = "angles are about fixed z, x, y: octo and openvla take them for roll, pitch, yaw"
_WATCHED = (
    "1 is closed, as thu-ml/RoboticsDiffusionTransformer found by watching episodes: octo and openvla keep it the wrong"
    " way round"
)


def _reached(
    name: str,
    hz: float,
    rotation: RotationKind,
    gripper_state: Column | None = None,
    gripper: Column | None = None,
    state: str = "observation/state",
    scale: float = 1.0,
    images: dict[View, str] = IMAGE,
    notes: tuple[str, ...] = (),
) -> OxeDataset:
    """One arm, whose pose is the first six columns of the state: `scale` metres, radians."""
    gripper = opening(6) if gripper is None else gripper
    arm = Arm(gripper=gripper, pose=pose(read(state, 0, 6), rotation, scale), gripper_state=gripper_state)
    return converted(name, hz, images, arm, notes=(_UNCLEAR, *notes))


def _pr2(name: str) -> OxeDataset:
    measured = openness(read("observation/state", 6, 7), 0, 86)
    notes = (
        "positions and the gripper's width are millimetres, as thu-ml/RoboticsDiffusionTransformer reads them",
        "which way the gripper's action goes is not told: the opening of the next step is the command",
    )
    return _reached(name, 10, "rpy", gripper=following(measured), gripper_state=measured, scale=1e-3, notes=notes)


DATASETS = [
    _pr2(f"utokyo_pr2_opening_fridge{SUFFIX}"),
    _pr2(f"utokyo_pr2_tabletop_manipulation{SUFFIX}"),
    _reached(
        f"utokyo_xarm_pick_and_place{SUFFIX}",
        10,
        "ypr",
        images={"primary": "image", "secondary": "image2", "wrist": "hand_image"},
        gripper=closing(7),
        state="observation/end_effector_pose",
        notes=(
            "angles come as yaw, pitch, roll",
            "the gripper's action is the trigger of the controller (frt03/rlds_dataset_builder), which closes: octo and"
            " openvla keep it the wrong way round",
        ),
    ),
    converted(
        f"utokyo_xarm_bimanual{SUFFIX}",
        10,
        IMAGE,
        Arm(gripper=opening(6), pose=pose(read("observation/pose_l"), "ypr")),
        Arm(gripper=opening(13), pose=pose(read("observation/pose_r"), "ypr")),
        notes=(
            _UNCLEAR,
            "two arms, left first: octo and openvla throw the left one away",
            "angles come as yaw, pitch, roll",
            OPENING_DOUBTED,
        ),
    ),
    _reached(
        f"tokyo_u_lsmo{SUFFIX}",
        10,
        "rpy",
        notes=("unsure: the measured gripper is always 0, which thu-ml/RoboticsDiffusionTransformer takes for open",),
    ),
    *(
        _reached(f"dlr_sara_{task}{SUFFIX}", 10, "zxy", gripper=closing(7), notes=(_ZXY, _WATCHED))
        for task in ("pour", "grid_clamp")
    ),
    _reached(
        f"dlr_edan_shared_control{SUFFIX}",
        5,
        "zxy",
        gripper=closing(7),
        gripper_state=openness(read("observation/state", 6, 7), 1, 0),
        notes=(_ZXY,),
    ),
    _reached(
        f"asu_table_top{SUFFIX}",
        12.5,
        "rpy",
        gripper_state=openness(read("observation/state", 6, 7), 0, 1),
        state="ground_truth_states/EE",
        notes=("the page calls the action joint velocities",),
    ),
]
