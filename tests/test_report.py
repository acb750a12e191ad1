import base64
import html.parser
import io
import json
import re
from typing import Literal

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from rich.console import Console

from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.conditions import Conditions
from dsvla_jax.evaluation.pictures import film_strip, mark_targets
from dsvla_jax.evaluation.report import print_comparison, print_table, write_report
from dsvla_jax.evaluation.results import (
    EpisodeResult,
    checkpoints_of,
    compare_physics,
    finished_tasks,
    latest,
    macro_mean,
    merge_results,
    read_results,
    success_rates,
    write_results,
)
from dsvla_jax.evaluation.seeing import KeyframeErrors, read_errors, write_errors
from dsvla_jax.evaluation.statistics import Pairs, paired_interval, wilson_interval
from dsvla_jax.geometry.cameras import front_camera, project


@pytest.mark.parametrize(("successes", "trials"), [(8, 10), (0, 10), (50, 100), (25, 25), (1, 3)])
@pytest.mark.parametrize("confidence", [0.95, 0.8])
def test_wilson_interval_equals_scipys(successes, trials, confidence):
    expected = scipy.stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    np.testing.assert_allclose(wilson_interval(successes, trials, confidence), expected, atol=1e-12)


def test_wilson_interval_has_the_known_values():
    np.testing.assert_allclose(wilson_interval(8, 10), (0.4901625, 0.9433178), atol=1e-7)
    np.testing.assert_allclose(wilson_interval(50, 100), (0.4038315, 0.5961685), atol=1e-7)


def test_wilson_interval_at_its_ends_and_beyond():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert wilson_interval(0, 7)[0] == 0.0
    assert wilson_interval(7, 7)[1] == 1.0
    with pytest.raises(ValueError, match="8 successes of 7"):
        wilson_interval(8, 7)


def result(task, episode, success, physics: Literal["mujoco", "mjx"] = "mujoco", **changes):
    fields = {
        "reason": "" if success else "out of keyframes",
        "keyframes": 2,
        "instruction": "turn on the <lamp> & wait",
        "answers": ["28 -1 140", "30 2 90"],
    }
    conditions = Conditions(physics=physics, **changes)
    return EpisodeResult(task=task, episode=episode, success=success, conditions=conditions, **fields)


RESULTS = [result("lamp_on", seed, seed < 3) for seed in range(4)] + [result("lift_ball", 0, False)]


def test_results_survive_the_file(tmp_path):
    shifted = [result("lamp_on", 0, True, shifts=("camera", "position"), keypoint_noise=0.1, step=3, digest="a")]
    write_results(tmp_path / "eval", [*RESULTS, *shifted])
    assert read_results(tmp_path / "eval") == [*RESULTS, *shifted]
    path = tmp_path / "eval" / "results.jsonl"
    assert len(path.read_text().splitlines()) == len(RESULTS) + 1
    path.write_text(path.read_text() + '{"task": "lam')
    with pytest.raises(UserError, match=r"results\.jsonl, line 7"):
        read_results(tmp_path / "eval")
    assert read_results(tmp_path / "nothing") == []


def test_rates_count_every_task_the_same_in_the_mean():
    rates = success_rates(RESULTS)
    assert [(rate.name, rate.successes, rate.trials) for rate in rates] == [("lamp_on", 3, 4), ("lift_ball", 0, 1)]
    assert macro_mean(rates) == pytest.approx(0.375)
    console = Console(file=(output := io.StringIO()), width=100)
    print_table(RESULTS, console)
    text = output.getvalue()
    for expected in ("lamp_on", "3/4", "75.0", "30.1 to 95.4", "3/5", "60.0", "37.5"):
        assert expected in text
    print_table([], console)


def test_physics_are_compared_on_shared_episodes_only():
    other = [result("lamp_on", seed, seed > 0, "mjx") for seed in range(1, 9)]
    comparison = compare_physics(RESULTS, other)
    assert comparison.names == ("mujoco", "mjx")
    (row,) = comparison.tasks
    assert (row.task, row.first.successes, row.second.successes, row.first.trials) == ("lamp_on", 2, 3, 3)
    assert (row.only_first, row.only_second) == (0, 1)
    assert [(one.episode, two.episode) for one, two in comparison.differing] == [(3, 3)]


def test_targets_are_drawn_where_the_camera_sees_them():
    camera = front_camera(96)
    frame = np.full((96, 96, 3), 128, np.uint8)
    targets = jnp.array([[0.2, 0.1, 0.9], [0.2, -0.15, 1.0]])
    marked = mark_targets(frame, targets, camera)
    assert (frame == 128).all()
    for (u, v), colour in zip(project(targets, camera)[0], ((255, 0, 200), (0, 220, 255)), strict=True):
        np.testing.assert_allclose(marked[round(float(v)), round(float(u))], colour, atol=60)
    assert (marked != 128).any(-1).mean() < 0.05
    beside = mark_targets(frame, [[0.2, 3.0, 0.9]], camera)
    assert (beside[:, 88:] != 128).any()
    assert (beside[:, :88] == 128).all()
    assert (mark_targets(frame, [[3.0, 0.0, 1.0]], camera) == 128).all()


def test_a_long_film_is_thinned_but_keeps_its_ends():
    frames = [np.full((8, 8, 3), 10 * i, np.uint8) for i in range(20)]
    strip = film_strip(frames, max_frames=5)
    assert strip.shape == (8, 5 * 8 + 4 * 2, 3)
    assert (strip[0, 0, 0], strip[0, -1, 0]) == (0, 190)


class Page(html.parser.HTMLParser):
    """Collects images and outside references, and checks that tags close in order."""

    VOID = ("meta", "img", "input")

    def __init__(self, text):
        super().__init__()
        self.images, self.links, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        attributes = dict(attrs)
        if tag == "img":
            self.images.append(attributes["src"])
        self.links += [value for name, value in attrs if name in ("href", "src") and value]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        pass


def test_the_report_is_one_page_that_holds_everything(tmp_path):
    path = tmp_path / "report.html"
    frames = [np.full((16, 16, 3), shade, np.uint8) for shade in (10, 200)]
    write_report(path, RESULTS, {("lamp_on", 1): frames}, [result("lamp_on", 3, True, "mjx")])
    text = path.read_text()
    page = Page(text)
    assert page.open == []
    assert all(link.startswith(("#", "data:")) for link in page.links)
    (image,) = page.images
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(image.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(picture, film_strip(frames))
    assert "turn on the &lt;lamp&gt; &amp; wait" in text
    assert "Where physics differ" in text
    assert len(re.findall(r'<div class="episode', text)) == len(RESULTS)
    write_report(path, RESULTS)
    assert "Where physics differ" not in path.read_text()
    assert "What it sees" not in path.read_text()
    write_report(path, [])
    assert "no episodes" in path.read_text()


def test_the_report_shows_what_a_policy_owes_to_what_it_sees(tmp_path):
    grey = [result("lamp_on", episode, episode == 0, withheld=("colour", "depth")) for episode in range(4)]
    errors = [
        KeyframeErrors("lamp_on", 1, (), 1.25, 4.4, 1.0, 60.0),
        KeyframeErrors("lamp_on", 2, (), 0.5, 90.0, 1.0, 0.0),
        KeyframeErrors("lamp_on", 1, ("own_pictures",), 20.0, 70.6, 0.5, 60.0),
    ]
    write_report(tmp_path / "report.html", RESULTS, withheld=[grey], errors=errors)
    text = (tmp_path / "report.html").read_text()
    assert Page(text).open == []
    rows = [
        re.findall(r"<t[hd][^>]*>([^<]*)", row) for row in re.findall(r"<tr>.*?</tr>", text.split("What it sees")[1])
    ]
    assert ["task", "as it is", "without colour, depth"] in rows
    assert ["lamp_on", "75", "25"] in rows
    assert ["lift_ball", "0", ""] in rows
    assert ["mean of the task that all have", "75.0", "25.0"] in rows, "not of lift_ball, which one of them lacks"
    assert ["task, keyframe", "as it is", "without own pictures"] in rows
    assert ["lamp_on, 1", "1.2; 4", "20.0; 71"] in rows
    assert ["lamp_on, 2", "0.5", ""] in rows, "a rotation that is always the same is not an error of seeing"


def test_errors_are_those_of_their_checkpoint(tmp_path):
    errors = [KeyframeErrors("lamp_on", 1, ("colour", "depth"), 1.25, 4.4, 1.0, 60.0)]
    assert read_errors(tmp_path, "abc") == []
    write_errors(tmp_path, "abc", errors)
    assert read_errors(tmp_path, "abc") == errors
    assert read_errors(tmp_path, "later") == []
    (tmp_path / "seeing.json").write_text('{"digest": "abc", "errors": [{"task": 1}]}')
    with pytest.raises(UserError, match=r"seeing\.json: not what benchmarks\.seeing wrote"):
        read_errors(tmp_path, "abc")


def test_runs_are_compared_on_the_tasks_that_all_have():
    console = Console(record=True, width=100, file=io.StringIO())
    other = [result("lamp_on", seed, True) for seed in range(4)]
    print_comparison({"one": RESULTS, "two": other}, console)
    text = console.export_text()
    assert re.search(r"lamp_on\D+75\.0 \(30 to 95\)\D+100\.0 \(51 to 100\)", text)
    assert re.search(r"lift_ball\D+0\.0 \(0 to 79\)\D+-", text)
    assert re.search(r"mean of the task that all have\D+75\.0\D+100\.0", text)
    # Of four episodes that both have, three are alike; the one of the other task has no pair.
    low, high = paired_interval(Pairs(both=3, first=1, second=0, neither=0))
    assert f"+25.0 ({100 * low:+.0f} to {100 * high:+.0f})" in text
    assert re.search(r"exact test\)\W+1 ", text)


@pytest.mark.parametrize("width", [60, 100])
def test_names_of_runs_and_tasks_are_told_apart_on_a_narrow_terminal(width: int):
    names = [f"runs/paper_7b_finetuned_with_keypoints_and_shifted_worlds_{end}[bold]" for end in ("one", "two")]
    task = "take_umbrella_out_of_umbrella_stand_and_open_it_over_the_table"
    console = Console(record=True, width=width, file=io.StringIO())
    print_comparison({name: [result(task, 0, True)] for name in names}, console)
    print_table([result(task, 0, True)], console)
    text = console.export_text()
    assert "…" not in text
    rows = [[cell.strip() for cell in re.split("[│┃]", line)[1:-1]] for line in text.splitlines()]
    columns = zip(*(row for row in rows if len(row) == 3), strict=True)
    whole = ["".join(column) for column in columns]
    for name, column in zip(names, whole[1:], strict=True):
        assert name in column
    assert task in whole[0]


AT_ONE, AT_TWO = {"step": 1, "digest": "a"}, {"step": 2, "digest": "b"}


def test_a_result_replaces_the_one_of_its_episode_and_conditions_alone():
    earlier = [result(task, episode, True, **AT_ONE) for task in ("lamp_on", "close_box") for episode in range(3)]
    fresh = [
        result("lamp_on", 0, False, **AT_ONE),
        result("lift_ball", 0, True, **AT_ONE),
        result("lamp_on", 1, False, **AT_TWO),
        result("lamp_on", 2, False, shifts=("camera",), **AT_ONE),
    ]
    assert merge_results(earlier, fresh) == [*earlier[1:], *fresh]


def test_of_each_task_the_latest_matching_conditions_are_chosen():
    old = [result(task, episode, True, **AT_ONE) for task in ("lamp_on", "close_box") for episode in (1, 0)]
    new, shifted = result("lamp_on", 0, False, **AT_TWO), result("close_box", 0, True, shifts=("camera",), **AT_TWO)
    chosen = latest([*old, new, shifted], lambda conditions: not conditions.shifts)
    assert chosen == [new, old[3], old[2]]
    assert checkpoints_of(chosen) == "step 2: lamp_on; step 1: close_box"
    assert checkpoints_of([new]) == "step 2"
    assert checkpoints_of(RESULTS) == ""
    assert finished_tasks(old, Conditions(**AT_ONE), 2) == {"lamp_on", "close_box"}
    assert finished_tasks(old, Conditions(**AT_ONE), 3) == finished_tasks(old, Conditions(**AT_TWO), 1) == set()


def test_physics_are_compared_on_the_same_checkpoint_only():
    one = [result("lamp_on", 0, True, **AT_ONE)]
    assert compare_physics(one, [result("lamp_on", 0, False, "mjx", **AT_TWO)]).tasks == []
    assert len(compare_physics(one, [result("lamp_on", 0, False, "mjx", **AT_ONE)]).differing) == 1


def test_results_of_earlier_versions_are_read(tmp_path):
    """One file for each kind of conditions, with `seed` and `actions`; the earliest without conditions."""
    plain = {"task": "lamp_on", "seed": 0, "physics": "mjx", "success": True, "reason": "", "keyframes": 2}
    plain |= {"instruction": "turn on the <lamp> & wait", "actions": ["28 -1 140", "30 2 90"]}
    known = {"step": 1, "digest": "a", "physics": "mjx", "keypoints": "oracle", "keypoint_noise": 0.0}
    known |= {"shifts": [], "seed": 0, "choice": "greedy", "image_size": 96}
    (tmp_path / "mjx.jsonl").write_text(json.dumps(plain) + "\n")
    (tmp_path / "mjx-step-1.jsonl").write_text(json.dumps({**plain, "conditions": known}) + "\n")
    new = result("lamp_on", 0, False)
    write_results(tmp_path, [new])
    assert read_results(tmp_path) == [
        result("lamp_on", 0, True, "mjx", step=1, digest="a", keypoints="oracle", image_size=96),
        result("lamp_on", 0, True, "mjx"),
        new,
    ]
