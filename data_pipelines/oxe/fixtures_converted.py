"""Builds of `datasets_converted` and `datasets_reached`.

Features as on each dataset's page of https://www.tensorflow.org/datasets/catalog.
"""

import dataclasses

import numpy as np

from data_pipelines.oxe.fixture_build import TOLD, Fixture, Values
from data_pipelines.oxe.fixture_motion import StepOf

_SUFFIX = "_converted_externally_to_rlds"
_BOTH = "observation/image=J128x128 observation/wrist_image=J128x128"
_BGR = ("image", "wrist_image")


def _closing(s: StepOf) -> float:
    """-1 for open, 1 for closed."""
    return 1 - 2 * s.open


def _osc(s: StepOf, _: StepOf) -> Values:
    # robosuite flattens by rows, libfranka by columns.
    return {
        "action": [*s.dp, *s.drpy, _closing(s)],
        "observation/state": [*s.noise(7), 0.08 * s.was, *s.matrix.ravel()],
    }


_STATE24 = Fixture(f"{TOLD} action=7 {_BOTH} observation/state=24", _osc)


def _sailor(s: StepOf, _: StepOf) -> Values:
    return {
        "action": [*s.dp, *s.drpy, _closing(s)],
        "observation/state": [*s.p, *s.xyzw, s.was],
        "observation/state_gripper": [0.077 * s.was],
    }


def _sirius(s: StepOf, _: StepOf) -> Values:
    return {
        "action": [*s.dp, *s.drpy, _closing(s)],
        "observation/state_ee": s.matrix,
        "observation/state_gripper": [0.077 * s.was],
    }


def _pr2() -> Fixture:
    return Fixture(
        f"{TOLD} action=8 observation/image=J128x128 observation/state=7",
        lambda s, _: {
            "action": s.noise(8),
            "observation/state": [*s.p * 1000, *s.rpy, 86 * s.was],
        },
    )


def _maniskill(s: StepOf, _: StepOf) -> Values:
    camera = camera_from_world()
    return {
        "action": [*s.tool_dp / 0.1, *s.tool_drotvec / 0.1, 2 * s.open - 1],
        "observation/tcp_pose": [*s.p, *s.wxyz],
        "observation/state": [*s.noise(7), 0.04 * s.was, 0.04 * s.was, *s.noise(9)],
        "observation/depth": DEPTH_COUNTS,
        "observation/main_camera_intrinsic_cv": [200, 0, 128, 0, 200, 128, 0, 0, 1],
        "observation/main_camera_extrinsic_cv": camera,
    }


DEPTH_COUNTS = 1536
"""Of every pixel of maniskill's fixture: 1.5 m."""


def camera_from_world() -> np.ndarray:
    """(4, 4): a camera 1.5 m above the origin that looks straight down, its picture's right along world y."""
    return np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 1.5], [0, 0, 0, 1]], float)


FIXTURES = {
    f"stanford_kuka_multimodal_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=4 observation/contact=50 observation/depth_image=128x128x1"
        " observation/ee_forces_continuous=50x6 observation/ee_orientation=4 observation/ee_orientation_vel=3"
        " observation/ee_position=3 observation/ee_vel=3 observation/ee_yaw=4 observation/ee_yaw_delta=4"
        " observation/image=J128x128 observation/joint_pos=7 observation/joint_vel=7 observation/optical_flow=128x128x2"
        " observation/state=8",
        lambda s, _: {
            "action": [*s.dp, s.open],
            "observation/ee_position": s.p,
            "observation/ee_orientation": s.xyzw,
        },
        kind="still",
        episode="",
    ),
    f"nyu_rot_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/image=J84x84 observation/state=7",
        lambda s, _: {"action": [*s.dp, *s.drpy, 1 - s.open], "observation/state": [*s.p, *s.rpy, 1 - s.was]},
    ),
    f"stanford_hydra_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=7 is_dense=b observation/image=J240x320 observation/state=27 observation/wrist_image=J240x320",
        lambda s, _: {
            "action": [*s.dp, *s.drpy, 1 - s.open],
            "observation/state": [*s.p, *s.xyzw, *s.rpy, *s.noise(17)],
        },
        bgr=_BGR,
    ),
    f"austin_buds_dataset{_SUFFIX}": _STATE24,
    "utaustin_mutex": dataclasses.replace(_STATE24, bgr=_BGR),
    f"nyu_franka_play_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=15 observation/depth=128x128x1i observation/depth_additional_view=128x128x1i"
        " observation/image=J128x128 observation/image_additional_view=J128x128 observation/state=13",
        lambda s, _: {
            "action": [*s.noise(7), *s.dp, *s.drpy, s.open, 0],
            "observation/state": [*s.noise(7), *s.p, *s.rpy],
        },
    ),
    f"maniskill_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/base_pose=7 observation/depth=D256x256 observation/image=J256x256"
        " observation/main_camera_cam2world_gl=4x4 observation/main_camera_extrinsic_cv=4x4"
        " observation/main_camera_intrinsic_cv=3x3 observation/state=18 observation/target_object_or_part_final_pose=7"
        " observation/target_object_or_part_final_pose_valid=7u observation/target_object_or_part_initial_pose=7"
        " observation/target_object_or_part_initial_pose_valid=7u observation/tcp_pose=7"
        " observation/wrist_camera_cam2world_gl=4x4 observation/wrist_camera_extrinsic_cv=4x4"
        " observation/wrist_camera_intrinsic_cv=3x3 observation/wrist_depth=D256x256 observation/wrist_image=J256x256",
        _maniskill,
        episode="episode_metadata/episode_id=t episode_metadata/file_path=t",
    ),
    f"furniture_bench_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=8 skill_completion=f observation/image=J224x224 observation/state=35"
        " observation/wrist_image=J224x224",
        lambda s, _: {
            "action": [*s.dp, *s.dxyzw, _closing(s)],
            "observation/state": [*s.p, *s.xyzw, *s.noise(27), 0.08 * s.was],
        },
        episode="episode_metadata/file_path=t episode_metadata/furniture=t",
    ),
    f"cmu_franka_exploration_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=8 observation/highres_image=J480x640 observation/image=J64x64 structured_action=8",
        lambda s, _: {"action": [*s.dp, *s.noise(3), s.open, 0]},
        kind="still",
    ),
    f"ucsd_kitchen_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=8 observation/image=J480x640 observation/state=21",
        lambda s, _: {"action": [*s.p * 1000, *np.degrees(s.rpy), s.open, 0]},
    ),
    f"ucsd_pick_and_place_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=4 observation/image=J224x224 observation/state=7",
        lambda s, _: {"action": [*s.dp, *s.noise(1)], "observation/state": [*s.p * 10, *s.rpy, 6.03 * s.was]},
        kind="still",
        episode="episode_metadata/file_path=t episode_metadata/success=b episode_metadata/n_transitions=i",
    ),
    f"austin_sailor_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=7 {_BOTH} observation/state=8 observation/state_ee=16 observation/state_gripper=1"
        " observation/state_joint=7",
        _sailor,
    ),
    f"austin_sirius_dataset{_SUFFIX}": Fixture(
        f"{TOLD} action=7 action_mode=1 intv_label=1 observation/image=J84x84 observation/wrist_image=J84x84"
        " observation/state=8 observation/state_ee=16 observation/state_gripper=1 observation/state_joint=7",
        _sirius,
    ),
    f"utokyo_pr2_opening_fridge{_SUFFIX}": _pr2(),
    f"utokyo_pr2_tabletop_manipulation{_SUFFIX}": _pr2(),
    f"utokyo_xarm_pick_and_place{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/end_effector_pose=6 observation/hand_image=J224x224 observation/image=J224x224"
        " observation/image2=J224x224 observation/joint_state=14 observation/joint_trajectory=21",
        lambda s, _: {"action": [*s.noise(6), 1 - s.open], "observation/end_effector_pose": [*s.p, *s.ypr]},
    ),
    f"utokyo_xarm_bimanual{_SUFFIX}": Fixture(
        f"{TOLD} action=14 observation/action_l=7 observation/action_r=7 observation/image=J256x256"
        " observation/pose_l=6 observation/pose_r=6",
        lambda left, right: {
            "action": [*left.noise(6), left.open, *right.noise(6), right.open],
            "observation/pose_l": [*left.p, *left.ypr],
            "observation/pose_r": [*right.p, *right.ypr],
        },
        arms=2,
    ),
    "robo_net": Fixture(
        f"{TOLD} action=5 observation/image=J240x320 observation/image1=J240x320 observation/image2=J240x320"
        " observation/state=5",
        lambda s, _: {"action": [*s.dp, *s.dyaw, _closing(s)], "observation/state": [*s.p, *s.yaw, s.was]},
        kind="yaw",
        episode="episode_metadata/file_path=t episode_metadata/robot=t",
    ),
    f"berkeley_mvp{_SUFFIX}": Fixture(
        f"{TOLD} action=8 observation/gripper=b observation/hand_image=J480x640 observation/joint_pos=7"
        " observation/pose=7",
        lambda s, _: {
            "action": [*s.noise(7), 1 - s.open],
            "observation/gripper": s.was < 0.5,
            "observation/pose": [*s.p, *s.xyzw],
        },
    ),
    f"berkeley_rpt{_SUFFIX}": Fixture(
        f"{TOLD} action=8 observation/gripper=b observation/hand_image=J480x640 observation/joint_pos=7",
        lambda s, _: {
            "action": [*s.noise(7), 1 - s.open],
            "observation/gripper": s.was < 0.5,
            "observation/joint_pos": [*s.p, *s.xyzw],
        },
    ),
    f"kaist_nonprehensile{_SUFFIX}": Fixture(
        f"{TOLD} action=20 observation/image=J480x640 observation/partial_pointcloud=512x3 observation/state=21",
        lambda s, _: {
            "action": [*s.dp, *s.drotvec, *s.noise(14)],
            "observation/state": [*s.noise(14), *s.p, *s.xyzw],
        },
    ),
    f"stanford_mask_vit{_SUFFIX}": Fixture(
        f"{TOLD} action=5 observation/end_effector_pose=5 observation/finger_sensors=1 observation/high_bound=5"
        " observation/image=J480x480 observation/low_bound=5 observation/state=15",
        lambda s, _: {
            "action": [*s.dp, *s.dyaw, _closing(s)],
            "observation/end_effector_pose": [*s.p, *s.yaw, *s.noise(1)],
        },
        kind="yaw",
    ),
    f"tokyo_u_lsmo{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/image=J120x120 observation/state=13",
        lambda s, _: {"action": [*s.noise(6), s.open], "observation/state": [*s.p, *s.rpy, *s.noise(7)]},
    ),
    f"dlr_sara_pour{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/image=J480x640 observation/state=6",
        lambda s, _: {"action": [*s.noise(6), 1 - s.open], "observation/state": [*s.p, *s.zxy]},
    ),
    f"dlr_sara_grid_clamp{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/image=J480x640 observation/state=12",
        lambda s, _: {"action": [*s.noise(6), 1 - s.open], "observation/state": [*s.p, *s.zxy, *s.noise(6)]},
    ),
    f"dlr_edan_shared_control{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/image=J360x640 observation/state=7",
        lambda s, _: {"action": [*s.noise(6), 1 - s.open], "observation/state": [*s.p, *s.zxy, 1 - s.was]},
    ),
    f"asu_table_top{_SUFFIX}": Fixture(
        f"{TOLD} action=7 action_delta=7 action_inst=t goal_object=t ground_truth_states/EE=6"
        " ground_truth_states/bottle=6 ground_truth_states/cube=6 observation/image=J224x224 observation/state=7"
        " observation/state_vel=7",
        lambda s, _: {
            "action": [*s.noise(6), s.open],
            "ground_truth_states/EE": [*s.p, *s.rpy],
            "observation/state": [*s.noise(6), s.was],
        },
    ),
    f"stanford_robocook{_SUFFIX}": Fixture(
        f"{TOLD} action=7 observation/depth_1=256x256 observation/depth_2=256x256 observation/image_1=J256x256"
        " observation/image_2=J256x256 observation/image_3=J256x256 observation/image_4=J256x256 observation/state=7",
        lambda s, _: {
            "action": [*s.dp * 5, *s.drotvec * 5, 0.08 * (s.next_was - s.was) * 5],
            "observation/state": [*s.p, *s.rpy, 0.08 * s.was],
        },
        episode="episode_metadata/extrinsics_1=4x4 episode_metadata/extrinsics_2=4x4 episode_metadata/extrinsics_3=4x4"
        " episode_metadata/extrinsics_4=4x4 episode_metadata/file_path=t",
    ),
    "imperialcollege_sawyer_wrist_cam": Fixture(
        f"{TOLD} action=8 observation/image=J64x64 observation/state=1 observation/wrist_image=J64x64",
        lambda s, _: {"action": [*s.tool_dp, *s.tool_dypr, s.open, 0], "observation/state": [s.was]},
    ),
    f"iamlab_cmu_pickup_insert{_SUFFIX}": Fixture(
        f"{TOLD} action=8 observation/image=J360x640 observation/state=20 observation/wrist_image=J240x320",
        lambda s, _: {
            "action": [*s.next_p, *s.next_wxyz, s.open],
            "observation/state": [*s.noise(7), s.was, *s.noise(12)],
        },
    ),
    "uiuc_d3field": Fixture(
        f"{TOLD} action=3 observation/depth_1=D360x640 observation/depth_2=D360x640 observation/image_1=J360x640"
        " observation/image_2=J360x640 observation/image_3=J360x640 observation/image_4=J360x640 observation/state=4x4",
        lambda s, _: {"action": s.dp, "observation/state": s.matrix},
        kind="still",
    ),
    "berkeley_fanuc_manipulation": Fixture(
        f"{TOLD} action=6 observation/end_effector_state=7 observation/image=J224x224 observation/state=13"
        " observation/wrist_image=J224x224",
        lambda s, _: {
            "action": [*s.dp, *s.drpy],
            "observation/end_effector_state": [*s.p, *s.xyzw],
            "observation/state": [*s.noise(6), 1 - s.was, *s.noise(6)],
        },
        bgr=_BGR,
    ),
    "cmu_playing_with_food": Fixture(
        f"{TOLD} action=8 observation/finger_vision_1=P480x640 observation/finger_vision_2=P480x640"
        " observation/image=P480x640 observation/state=6",
        lambda s, _: {"action": [*s.p, *s.wxyz, s.open]},
        kind="still",
        bgr=("image", "finger_vision_1", "finger_vision_2"),
    ),
    "cmu_play_fusion": Fixture(
        f"{TOLD} action=9 observation/image=J128x128 observation/state=8",
        lambda s, _: {"action": [*s.dp, *s.dxyzw, s.open, 0], "observation/state": [*s.noise(7), 0.085 * s.was]},
    ),
    "cmu_stretch": Fixture(
        f"{TOLD} action=8 observation/image=J128x128 observation/state=4",
        lambda s, _: {"action": [*s.dp, *s.drpy, s.open, 0], "observation/state": [*s.p, s.was]},
        kind="still",
    ),
}
