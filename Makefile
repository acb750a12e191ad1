# Two commands do everything from a bare clone: `make train` and `make test`. The rest are conveniences.
PYTHON ?= python3
# One virtual environment a Python version, so that PYTHON=... never mixes two.
VENV := .venv-$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
PY := $(VENV)/bin/python
CONFIG ?= tiny
RUN ?= runs/$(CONFIG)
# Further options of train.py and eval.py, as in: make train TRAIN_OPTIONS="--steps 100"
TRAIN_OPTIONS ?=
EVAL_OPTIONS ?=

.PHONY: help setup train test test-slow parity bench lint format lock clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

# Compiling at installation makes programs start faster if PYTHONDONTWRITEBYTECODE is set, as in many containers.
$(VENV)/.synced: requirements.lock pyproject.toml
	@test -x $(PY) || $(PYTHON) -m venv $(VENV)
	@test -x $(VENV)/bin/uv || $(PY) -m pip install --quiet --disable-pip-version-check uv
	@echo "installing the locked packages into $(VENV)"
	@$(VENV)/bin/uv pip sync --quiet --compile-bytecode --python $(PY) requirements.lock
	@$(VENV)/bin/uv pip install --quiet --python $(PY) --no-deps --editable .
	@$(PY) -m pip --version >/dev/null
	@$(VENV)/bin/uv --version >/dev/null 2>&1 || $(PY) -m pip install --quiet --disable-pip-version-check uv
	@touch $@

setup: $(VENV)/.synced  ## make the virtual environment

train: setup  ## demonstrations, training, closed-loop evaluation and report for CONFIG (default: tiny)
	$(PY) train.py $(CONFIG) --run $(RUN) $(TRAIN_OPTIONS)
	$(PY) eval.py $(RUN) --skip-finished $(EVAL_OPTIONS)
	@echo "report: $(RUN)/eval/report.html"

test: setup  ## the test suite, on up to four cores
	$(PY) -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

test-slow: setup  ## the long tests too
	$(PY) -m pytest -m "slow or not slow"

parity: setup  ## live comparison with transformers, peft and TensorFlow, which are installed beside the locked packages
	$(VENV)/bin/uv pip install --quiet --python $(PY) "torch>=2.9" "torchvision>=0.24" "transformers>=5" "peft>=0.18" \
		"pillow>=11" "tensorflow-cpu>=2.21"
	$(PY) -m pytest -m parity
	$(PY) -m pytest tests/test_perception.py
	$(PY) -m benchmarks.rlds_parity

bench: setup  ## list the checks that take minutes
	$(PY) -m benchmarks

lint: setup  ## ruff and pyright
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)

format: setup  ## format the code
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

lock: setup  ## resolve requirements.lock again
	$(VENV)/bin/uv pip compile --universal --generate-hashes --no-header -q pyproject.toml --extra dev -o requirements.lock

clean:  ## remove caches and virtual environments; results and data stay
	rm -rf .venv-3.* .cache .pytest_cache .ruff_cache dist MUJOCO_LOG.TXT
	find . -name .git -prune -o -path ./runs -prune -o -path ./data -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
