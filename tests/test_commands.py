"""The commands of README and docs: each program knows the options it is shown with, and make the targets."""

import os
import re
import subprocess
from functools import partial
from pathlib import Path

import pytest

from benchmarks._commands import ROOT, Command, example_files, find_commands, indented_commands, pages, problem_with
from benchmarks.documented_commands import OWN, RULES, Rule, rule_of, text_to_run

SHOWN = [command for page in pages() for command in find_commands(page)]


def command(text: str, block: bool = True) -> Command:
    return Command("README.md", 1, text, block)


def test_every_shown_command_has_options_that_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for path, text in [item for page in pages() for item in example_files(page).items()]:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    problems = {shown.where: problem_with(shown) for shown in SHOWN}
    assert not {where: problem for where, problem in problems.items() if problem}


def test_every_shown_command_is_run_by_the_script_of_documented_commands():
    """benchmarks/documented_commands.py runs them in a fresh clone; a new kind of command needs a rule there."""
    assert not [f"{shown.where}: {shown.text}" for shown in SHOWN if rule_of(shown) is None]
    used = [rule_of(shown) for shown in SHOWN]
    assert not [rule.pattern for rule in RULES if rule not in used]


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_commands_stand_in_blocks_that_are_run(page: Path):
    assert not indented_commands(page)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("python train.py tiny --steps 2 --optimizer.learning-rat 1", "learning-rat"),
        ("python train.py tinny", "unknown config 'tinny'"),
        ("python trian.py tiny", "no program trian.py"),
        ("for i in 0 1; do\n  A=1 python train.py tiny --runn runs/two &\ndone; wait", "runn"),
        ("python -m data_pipelines.rlbench SRC data/rlbench --skip-badd", "skip-badd"),
        ("python -m data_pipelines.rlbensh SRC data/rlbench", "no program data_pipelines.rlbensh"),
        ("python -m data_pipelines.oxe prepare --foldr data/oxe", "foldr"),
        ("python -m benchmarks.raycast_parity --task lift_cube --sizes 3", "sizes"),
        ("python -m benchmarks.render_speed --tasks lift_cube", "no option --tasks"),
        ("make trian", "no target trian"),
        ('pip install -e ".[plannner]"', "no extra plannner"),
        ('pip install "dsvla-jax[planner]"', "on no index"),
        ("sbatch cluster/slrum.sh tiny", "no file cluster/slrum.sh"),
    ],
)
def test_a_wrong_command_is_found(text: str, problem: str):
    assert problem in re.sub(r"\s+", " ", problem_with(command(text)) or "")


def test_commands_of_a_page_are_found_whole(tmp_path: Path):
    page = tmp_path / "README.md"
    page.write_text(
        "Run `make  bench`, or:\n\n```sh\npython train.py tiny   # a comment\n\nA=$(echo 1)\necho $A\n"
        'for i in 0 1; do\n  echo "$i # no comment"\ndone\n'
        "python eval.py \\\n  runs/tiny\n```\n\n```python\n# own.py\nx = 1\n```\n"
    )
    found = [(one.line, one.text, one.block) for one in find_commands(page, tmp_path)]
    assert found == [
        (1, "make bench", False),
        (4, "python train.py tiny", True),
        (6, "A=$(echo 1)\necho $A", True),
        (8, 'for i in 0 1; do\n  echo "$i # no comment"\ndone', True),
        (11, "python eval.py \\\n  runs/tiny", True),
    ]
    assert example_files(page) == {"own.py": "# own.py\nx = 1\n"}


def test_toy_size_replaces_the_numbers_of_a_command_and_nothing_else():
    rule = Rule("", "--steps 2 --episodes 1", OWN)
    shown = command("for i in 0; do python train.py tiny --steps 300 --run RUN --episodes 5 7 & done")
    expected = "for i in 0; do python train.py tiny --run runs/tiny --steps 2 --episodes 1 & done"
    assert text_to_run(shown, rule) == expected


def test_make_help_lists_every_target_and_clean_keeps_results(tmp_path: Path):
    makefile = (ROOT / "Makefile").read_text()
    (tmp_path / "Makefile").write_text(makefile)
    (targets,) = re.findall(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)
    # As a user's shell calls it, even when `make test` is what runs this test.
    shell = {name: value for name, value in os.environ.items() if name not in ("MAKELEVEL", "MAKEFLAGS", "MFLAGS")}
    call = partial(subprocess.run, cwd=tmp_path, env=shell, capture_output=True, text=True, check=True)
    listed = call(["make", "help"]).stdout
    assert sorted(targets.split()) == sorted(line.split()[0] for line in listed.splitlines())
    kept = [
        "runs/tiny/config.json",
        "data/demos/index.json",
        "bases/x/a",
        "words/x/a",
        ".git/__pycache__/a",
        "train.py",
    ]
    removed = [".venv-3.11/bin/python", ".cache/xla/a", "tests/__pycache__/a.pyc", ".pytest_cache/a", ".ruff_cache/a"]
    for path in [*kept, *removed]:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    call(["make", "clean"])
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {*kept, "Makefile"}
