"""What a server says of itself on connecting: what the policy wants, because it learned from it."""

import dataclasses

from dsvla_jax.data_config import LearnedFrom
from dsvla_jax.encoding.text import WordTokenizer
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.interface import Policy
from dsvla_jax.serving.messages import Message
from dsvla_jax.serving.requests import Expected
from dsvla_jax.types import TABLE_HEIGHT

_FRAMES = {
    "simulator": f"z up, the table top at z = {TABLE_HEIGHT}",
    "demonstrations": "the world frame of the demonstrations",
    "oxe": "that of the datasets, the robot's base in most",
    None: "that of the training data",
}


def camera_names(config: PolicyConfig) -> tuple[str, ...]:
    """The names of a policy's cameras, made up if the data did not say."""
    names, count = config.learned_from.cameras if config.learned_from else (), config.model.cameras
    return names if len(names) == count else tuple(f"camera {number}" for number in range(count))


def describe(name: str, policy: Policy, expected: Expected, finds_keypoints: bool) -> Message:
    """The metadata. finds_keypoints: whether the server looks for those of robots that send none."""
    config, learned = policy.config, policy.config.learned_from
    several = {"cameras": list(expected.cameras)} if len(expected.cameras) > 1 else {}
    return {
        "name": name,
        "request": expected.required,
        "optional": expected.optional,
        "reply": {
            "actions": "float32 (1, A * 8): the next keyframe, x y z qx qy qz qw gripper_open of each arm",
            "text": "the policy's answer",
            "log_probs": "of each of its numbers, 8 an arm; empty for a policy that answers with poses",
            "keypoint": "the active keypoint of each arm, metres, world frame, or None",
            "reached": "how many keypoints each arm has reached",
            "points": "how many points of the depth map the policy used, or None without 3D input",
        },
        "learned_from": None if learned is None else _describe_learned(learned),
        "needs_keypoints": config.wants_keypoints and not finds_keypoints,
        "vocabulary": "words of the training data" if isinstance(policy.tokenizer, WordTokenizer) else "any words",
        "units": "metres, pixels, unit quaternions x y z w",
        "frame": _FRAMES[None if learned is None else learned.source],
        "image_sizes": [list(size) for size in expected.image_sizes],
        "arms": list(expected.arms),
        "workspace_low": list(expected.codec.low),
        "workspace_high": list(expected.codec.high),
        "max_message_bytes": expected.max_message_bytes,
        **several,
    }


def _describe_learned(learned: LearnedFrom) -> Message:
    """The fields; a single camera as `camera`, empty if its name is not known."""
    fields = dataclasses.asdict(learned)
    if len(learned.cameras) <= 1:
        del fields["cameras"]
        fields["camera"] = "".join(learned.cameras)
    return fields
