"""Builds of `datasets_other`: features as on each dataset's page of https://www.tensorflow.org/datasets/catalog, where
there is one, else as the projects publish them."""

from data_pipelines.oxe.fixture_build import STEP, TOLD, Fixture, Values
from data_pipelines.oxe.fixture_motion import StepOf

_PLAIN = f"{STEP} discount=f language_instruction=s"


def _gnm() -> Fixture:
    return Fixture(
        "is_first=b is_last=b is_terminal=b reward=d discount=d language_embedding=512 language_instruction=t action=2d"
        " action_angle=3d observation/image=J120x160 observation/position=2d observation/state=3d observation/yaw=1d",
        lambda s, _: {"action": s.dp[:2], "observation/position": s.p[:2], "observation/yaw": s.yaw},
        kind="navigation",
    )


def _aloha(left: StepOf, right: StepOf) -> Values:
    joints = [[*arm.p, *arm.rotvec] for arm in (left, right)]
    return {
        "action": [*left.noise(6), left.open, *right.noise(6), right.open],
        "observation/state": [*joints[0], left.was, *joints[1], right.was],
    }


_ALOHA = Fixture(
    f"{_PLAIN} action=14 observation/cam_high=J480x640 observation/cam_low=J480x640 observation/cam_left_wrist=J480x640"
    " observation/cam_right_wrist=J480x640 observation/state=14",
    _aloha,
    arms=2,
)


def _mobile(left: StepOf, right: StepOf) -> Values:
    values = _aloha(left, right)
    return {**values, "action": [*values["action"], *left.noise(2)]}


def _tdroid() -> Fixture:
    return Fixture(
        f"{TOLD} action=7 observation/cartesian_position=6 observation/gripper_position=1"
        " observation/static_image=J180x320 observation/static_depth_image=180x320x1 observation/joint_position=7",
        lambda s, _: {
            "action": [*s.dp, *s.drpy, s.open],
            "observation/cartesian_position": [*s.p, *s.rpy],
            "observation/gripper_position": [1 - s.was],
        },
    )


def _droid() -> Fixture:
    return Fixture(
        f"{STEP} discount=f language_instruction=s language_instruction_2=s language_instruction_3=s action=7d"
        " action_dict/cartesian_position=6d action_dict/cartesian_velocity=6d action_dict/gripper_position=1d"
        " action_dict/gripper_velocity=1d action_dict/joint_position=7d action_dict/joint_velocity=7d"
        " observation/cartesian_position=6d observation/exterior_image_1_left=J180x320"
        " observation/exterior_image_2_left=J180x320 observation/gripper_position=1d observation/joint_position=7d"
        " observation/wrist_image_left=J180x320",
        lambda s, _: {
            "action_dict/cartesian_velocity": [*s.dp, *s.drpy],
            "action_dict/gripper_position": [1 - s.open],
            "observation/cartesian_position": [*s.p, *s.rpy],
            "observation/gripper_position": [1 - s.was],
        },
        episode="episode_metadata/file_path=s episode_metadata/recording_folderpath=s",
    )


def _libero() -> Fixture:
    return Fixture(
        f"{STEP} discount=f language_instruction=t action=7 observation/image=J256x256 observation/joint_state=7"
        " observation/state=8 observation/wrist_image=J256x256",
        lambda s, _: {
            "action": [*s.dp / 0.05, *s.drotvec / 0.5, 1 - 2 * s.open],
            "observation/state": [*s.p, *s.rotvec, 0.04 * s.was, -0.04 * s.was],
        },
    )


FIXTURES = {
    "gnm_dataset": Fixture(
        f"{TOLD} action=2 observation/image=J120x160 observation/state=3",
        lambda s, _: {"action": s.dp[:2], "observation/state": [*s.p[:2], *s.yaw]},
        kind="navigation",
    ),
    **{name: _gnm() for name in ("berkeley_gnm_recon", "berkeley_gnm_cory_hall", "berkeley_gnm_sac_son")},
    "aloha_static_dataset": _ALOHA,
    "aloha_dagger_dataset": _ALOHA,
    "aloha_mobile_dataset": Fixture(
        f"{_PLAIN} action=16 observation/cam_high=J480x640 observation/cam_left_wrist=J480x640"
        " observation/cam_right_wrist=J480x640 observation/state=14",
        _mobile,
        arms=2,
        episode="episode_metadata/file_path=s",
    ),
    "fmb_dataset": Fixture(
        f"{STEP} discount=f language_embedding=512 language_instruction=s action=7 observation/color_id=u"
        " observation/eef_force=3 observation/eef_pose=7 observation/eef_torque=3 observation/eef_vel=6"
        " observation/image_side_1=J256x256 observation/image_side_1_depth=256x256 observation/image_side_2=J256x256"
        " observation/image_wrist_1=J256x256 observation/image_wrist_2=J256x256 observation/joint_pos=7"
        " observation/joint_vel=7 observation/length=s observation/object_id=u observation/primitive=s"
        " observation/shape_id=u observation/size=s observation/state_gripper_pose=f",
        lambda s, _: {
            "action": [*s.dp, *s.drpy, *s.noise(1)],
            "observation/eef_pose": [*s.p, *s.xyzw],
            "observation/state_gripper_pose": 1 - s.was,
        },
        episode="episode_metadata/episode_language_embedding=512 episode_metadata/episode_language_instruction=s"
        " episode_metadata/episode_task=s episode_metadata/file_path=s",
    ),
    "dobbe": Fixture(
        f"{STEP} discount=f language_embedding=512 language_instruction=s action=7 observation/gripper=1"
        " observation/quat=4 observation/rot=3 observation/state=7 observation/wrist_image=J256x256 observation/xyz=3",
        lambda s, _: {
            "action": [*s.dp, *s.tool_drpy, s.open],
            "observation/gripper": [s.was],
            "observation/quat": s.xyzw,
            "observation/xyz": s.p,
        },
        episode="episode_metadata/file_path=s",
    ),
    "roboset": Fixture(
        f"{_PLAIN} action=8 observation/image_left=J240x424 observation/image_right=J240x424"
        " observation/image_top=J240x424 observation/image_wrist=J240x424 observation/state=8"
        " observation/state_velocity=8",
        lambda s, _: {
            "action": [*s.noise(7), 1 - s.open],
            "observation/state": [*s.p, *s.xyzw, 1 - s.was],
        },
        episode="episode_metadata/file_path=s episode_metadata/trial_id=s",
    ),
    "mujoco_manip": Fixture(
        f"{TOLD} action=7 observation/image=J256x256 observation/proprio=8",
        lambda s, _: {"action": [*s.dp, *s.drpy, 255 * (1 - s.open)]},
    ),
    "droid": _droid(),
    "droid_wipe": _droid(),
    **{
        f"tdroid_{task}": _tdroid()
        for task in (
            "carrot_in_bowl",
            "pour_corn_in_pot",
            "flip_pot_upright",
            "move_object_onto_plate",
            "knock_object_over",
            "cover_object_with_towel",
        )
    },
    **{f"libero_{suite}_no_noops": _libero() for suite in ("spatial", "object", "goal", "10")},
}
