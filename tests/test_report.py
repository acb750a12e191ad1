import base64
import dataclasses
import html.parser
import io
import json
import re

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from rich.console import Console

from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.report import (
    EpisodeResult,
    checkpoints_of,
    compare_physics,
    film_strip,
    macro_mean,
    mark_targets,
    merge_results,
    print_comparison,
    print_table,
    read_results,
    success_rates,
    write_report,
    write_results,
)
from dsvla_jax.evaluation.statistics import wilson_interval
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


def result(task, seed, success, physics="mujoco", **changes):
    fields = {
        "reason": "" if success else "out of keyframes",
        "keyframes": 2,
        "instruction": "turn on the <lamp> & wait",
        "actions": ["28 -1 140", "30 2 90"],
    }
    return EpisodeResult(task=task, seed=seed, physics=physics, success=success, **{**fields, **changes})


RESULTS = [result("lamp_on", seed, seed < 3) for seed in range(4)] + [result("lift_ball", 0, False)]


def test_results_survive_the_file(tmp_path):
    path = tmp_path / "eval" / "mujoco.jsonl"
    write_results(path, RESULTS)
    assert read_results(path) == RESULTS
    assert len(path.read_text().splitlines()) == len(RESULTS)
    path.write_text(path.read_text() + '{"task": "lam')
    with pytest.raises(UserError, match=r"mujoco\.jsonl, line 6"):
        read_results(path)


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
    ((task, first, second, only_first, only_second),) = comparison.tasks
    assert (task, first.successes, second.successes, first.trials) == ("lamp_on", 2, 3, 3)
    assert (only_first, only_second) == (0, 1)
    assert [(one.seed, two.seed) for one, two in comparison.differing] == [(3, 3)]


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
    write_report(path, [])
    assert "no episodes" in path.read_text()


def test_runs_are_compared_on_the_tasks_that_all_have():
    console = Console(record=True, width=100, file=io.StringIO())
    other = [result("lamp_on", seed, True) for seed in range(4)]
    print_comparison({"one": RESULTS, "two": other}, console)
    text = console.export_text()
    assert re.search(r"lamp_on\D+75\.0 \(30 to 95\)\D+100\.0 \(51 to 100\)", text)
    assert re.search(r"lift_ball\D+0\.0 \(0 to 79\)\D+-", text)
    assert re.search(r"mean of the 1 tasks that all have\D+75\.0\D+100\.0", text)


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


def test_results_of_other_tasks_and_further_episodes_stay():
    earlier = [result(task, seed, True, conditions=AT_ONE) for task in ("lamp_on", "close_box") for seed in range(3)]
    fresh = [result("lamp_on", 0, False, conditions=AT_ONE), result("lift_ball", 0, True, conditions=AT_ONE)]
    merged, displaced = merge_results(earlier, fresh)
    assert merged == [fresh[0], *earlier[1:], fresh[1]]
    assert displaced == []


def test_results_of_another_checkpoint_are_displaced_task_by_task():
    without = [result("lamp_on", seed, True) for seed in range(3)]
    others = [result("close_box", 0, True, conditions=AT_ONE)]
    fresh = [result("lamp_on", 0, False, conditions=AT_TWO)]
    merged, displaced = merge_results([*without, *others], fresh)
    assert (merged, displaced) == ([*fresh, *others], without)
    assert checkpoints_of(merged) == "step 2: lamp_on; step 1: close_box"
    assert checkpoints_of(fresh) == "step 2"
    assert checkpoints_of(without) == ""


def test_physics_are_compared_on_the_same_checkpoint_only():
    one = [result("lamp_on", 0, True, conditions=AT_ONE)]
    assert compare_physics(one, [result("lamp_on", 0, False, "mjx", conditions=AT_TWO)]).tasks == []
    assert len(compare_physics(one, [result("lamp_on", 0, False, "mjx", conditions=AT_ONE)]).differing) == 1


def test_results_of_earlier_versions_are_read(tmp_path):
    row = dataclasses.asdict(RESULTS[0])
    del row["conditions"]
    (tmp_path / "mujoco.jsonl").write_text(json.dumps(row) + "\n")
    assert read_results(tmp_path / "mujoco.jsonl") == RESULTS[:1]
