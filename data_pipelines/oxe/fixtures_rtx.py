"""Builds of `datasets_rtx`: features as on each dataset's page of https://www.tensorflow.org/datasets/catalog."""

import numpy as np

from data_pipelines.oxe.fixture_build import NAMED, STEP, TOLD, Fixture, Values
from data_pipelines.oxe.fixture_motion import StepOf

_ACTION = "action/rotation_delta=3 action/world_vector=3"
_BASE = "action/base_displacement_vector=2 action/base_displacement_vertical_rotation=1 action/terminate_episode=3i"


def _moves(s: StepOf, rotation: bool = True) -> Values:
    turned = {"action/rotation_delta": s.drpy} if rotation else {}
    return {"action/world_vector": s.dp, **turned}


def _velocities(s: StepOf, hz: float) -> Values:
    return {"action/world_vector": s.dp * hz, "action/rotation_delta": s.drotvec * hz}


def _bridge(s: StepOf, _: StepOf) -> Values:
    # An opening that is on its way for one step; the first three columns are not the reached displacement.
    opening = 0.5 if s.open != s.was else s.open
    return {
        "action": [*(s.dp + 0.001), *s.drpy, opening if s.open < 0.5 else s.open],
        "observation/state": [*s.p, *s.rpy, s.was],
    }


_BRIDGE = Fixture(
    f"{TOLD} action=7 observation/image_0=J256x256 observation/image_1=J256x256 observation/image_2=J256x256"
    " observation/image_3=J256x256 observation/state=7",
    _bridge,
    episode="episode_metadata/file_path=t episode_metadata/has_language=b episode_metadata/episode_id=i",
)

FIXTURES = {
    "fractal20220817_data": Fixture(
        f"{NAMED} {_ACTION} {_BASE} action/gripper_closedness_action=1 observation/base_pose_tool_reached=7"
        " observation/gripper_closed=1 observation/gripper_closedness_commanded=1 observation/height_to_bottom=1"
        " observation/image=J256x320 observation/orientation_box=2x3 observation/orientation_start=4"
        " observation/robot_orientation_positions_box=3x3 observation/rotation_delta_to_go=3 observation/src_rotation=4"
        " observation/vector_to_go=3 observation/workspace_bounds=3x3",
        lambda s, _: {
            **_moves(s),
            "action/gripper_closedness_action": [s.closing],
            "observation/base_pose_tool_reached": [*s.p, *s.xyzw],
            "observation/gripper_closed": [1 - s.was],
        },
        episode="aspects/success=b aspects/feasible=b attributes/env=i attributes/env_name=s",
    ),
    "kuka": Fixture(
        f"{NAMED} {_ACTION} {_BASE} action/gripper_closedness_action=1"
        " observation/clip_function_input/base_pose_tool_reached=z7"
        " observation/clip_function_input/workspace_bounds=z3x3 observation/gripper_closed=z1"
        " observation/height_to_bottom=z1 observation/image=J512x640 observation/task_id=1",
        lambda s, _: {
            **_moves(s),
            "action/gripper_closedness_action": [s.closing],
            "observation/clip_function_input/base_pose_tool_reached": [*s.p, *s.xyzw],
            "observation/gripper_closed": [1 - s.was],
        },
        episode="success=b",
        episode_values=lambda: {"success": True},
    ),
    "bridge_dataset": _BRIDGE,
    "bridge_orig": _BRIDGE,
    "bridge_oxe": Fixture(
        f"{NAMED} {_ACTION} action/open_gripper=b action/terminate_episode=f observation/image=J480x640"
        " observation/state=7",
        lambda s, _: {**_moves(s), "action/open_gripper": s.open, "observation/state": [*s.p, *s.rpy, s.was]},
        episode="",
    ),
    "taco_play": Fixture(
        f"{NAMED} action/actions=7 action/rel_actions_gripper=7 action/rel_actions_world=7 action/terminate_episode=f"
        " observation/depth_gripper=84x84 observation/depth_static=150x200 observation/rgb_gripper=J84x84"
        " observation/rgb_static=J150x200 observation/robot_obs=15 observation/structured_language_instruction=s",
        lambda s, _: {
            "action/rel_actions_world": [*s.dp, *s.drpy, 2 * s.open - 1],
            "observation/robot_obs": [*s.p, *s.rpy, 0.08 * s.was, *s.noise(7), 2 * s.was - 1],
        },
        episode="",
    ),
    "jaco_play": Fixture(
        f"{NAMED} action/gripper_closedness_action=1 action/terminate_episode=3i action/world_vector=3"
        " observation/end_effector_cartesian_pos=7 observation/end_effector_cartesian_velocity=6"
        " observation/image=J224x224 observation/image_wrist=J224x224 observation/joint_pos=8",
        lambda s, _: {
            **_moves(s, rotation=False),
            "action/gripper_closedness_action": [s.closing],
            "observation/end_effector_cartesian_pos": [*s.p, *s.noise(4)],
        },
        kind="still",
        episode="",
    ),
    "berkeley_cable_routing": Fixture(
        f"{NAMED} {_ACTION} action/terminate_episode=f observation/image=J128x128 observation/robot_state=7"
        " observation/top_image=J128x128 observation/wrist225_image=J128x128 observation/wrist45_image=J128x128",
        lambda s, _: _velocities(s, 10),
        kind="yaw",
        episode="",
    ),
    "roboturk": Fixture(
        f"{NAMED} {_ACTION} action/gripper_closedness_action=1 action/terminate_episode=f"
        " observation/front_rgb=J480x640",
        lambda s, _: {**_moves(s), "action/gripper_closedness_action": [1 - 2 * s.open]},
        episode="",
    ),
    "nyu_door_opening_surprising_effectiveness": Fixture(
        f"{NAMED} {_ACTION} action/gripper_closedness_action=1 action/terminate_episode=f observation/image=J720x960",
        lambda s, _: {**_velocities(s, 3), "action/gripper_closedness_action": [s.closing]},
        episode="",
    ),
    "viola": Fixture(
        f"{NAMED} {_ACTION} action/gripper_closedness_action=f action/terminate_episode=f"
        " observation/agentview_rgb=J224x224 observation/ee_states=16 observation/eye_in_hand_rgb=J224x224"
        " observation/gripper_states=1 observation/joint_states=7",
        # libfranka writes its pose by columns.
        lambda s, _: {
            **_moves(s),
            "action/gripper_closedness_action": 1 - 2 * s.open,
            "observation/ee_states": s.matrix.T,
            "observation/gripper_states": [0.08 * s.was],
        },
        episode="",
    ),
    "berkeley_autolab_ur5": Fixture(
        f"{NAMED} {_ACTION} action/gripper_closedness_action=f action/terminate_episode=f"
        " observation/hand_image=J480x640 observation/image=J480x640 observation/image_with_depth=F480x640"
        " observation/robot_state=15",
        lambda s, _: {
            **_moves(s),
            "action/gripper_closedness_action": s.closing,
            "observation/robot_state": [*s.noise(6), *s.p, *s.xyzw, 1 - s.was, *s.noise(1)],
        },
        episode="",
        bgr=("hand_image",),
    ),
    "toto": Fixture(
        f"{NAMED} {_ACTION} action/open_gripper=b action/terminate_episode=f observation/image=J480x640"
        " observation/state=7",
        lambda s, _: {**_moves(s), "action/open_gripper": s.open},
        episode="",
    ),
    "language_table": Fixture(
        f"{STEP} action=2 observation/effector_target_translation=2 observation/effector_translation=2"
        " observation/instruction=512i observation/rgb=J360x640",
        lambda s, _: {"action": s.dp[:2], "observation/effector_translation": s.p[:2]},
        kind="planar",
        episode="episode_id=s",
    ),
    "columbia_cairlab_pusht_real": Fixture(
        f"{NAMED} {_ACTION} action/gripper_closedness_action=f action/terminate_episode=f observation/image=J240x320"
        " observation/robot_state=2 observation/wrist_image=J240x320",
        lambda s, _: {
            **_moves(s),
            "action/gripper_closedness_action": s.closing,
            "observation/robot_state": s.p[:2],
        },
        kind="planar",
        episode="",
    ),
    "bc_z": Fixture(
        f"{NAMED} action/future/axis_angle_residual=30 action/future/target_close=10l action/future/xyz_residual=30"
        " observation/episode_success=f observation/image=J171x213 observation/present/autonomous=i"
        " observation/present/axis_angle=3 observation/present/intervention=i observation/present/sensed_close=1"
        " observation/present/xyz=3 observation/sequence_length=i",
        lambda s, _: {
            "action/future/axis_angle_residual": [*(s.next_rotvec - s.rotvec), *s.noise(27)],
            "action/future/xyz_residual": [*s.dp, *s.noise(27)],
            "action/future/target_close": [1 - s.open, *np.ones(9)],
            "observation/present/axis_angle": s.rotvec,
            "observation/present/xyz": s.p,
            "observation/present/sensed_close": [1 - 0.8 * s.was],
        },
        episode="",
    ),
    "rh20t": Fixture(
        f"{TOLD} action/gripper=1 action/tcp_base=6 observation/gripper_width=1 observation/image_front=J128x128"
        " observation/image_side_right=J128x128 observation/image_wrist=J128x128 observation/tcp_base=6",
        lambda s, _: {
            "action/gripper": [s.open],
            "observation/gripper_width": [0.1 * s.was],
            "observation/tcp_base": [*s.p, *s.rpy],
        },
    ),
}
