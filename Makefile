# make demo: set-up and the whole way on a virtual robot. make test: set-up and the tests. make check: lint and types. make site: docs/ as a site.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
TOOLS := PATH="$(CURDIR)/.tools/bin:$$PATH"
# What the tests and the site need.
EXTRAS := train,gym,so101,zmq,ros,hdf5,hub,docs,dev
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Two pools of busy-waiting threads on two cores cost a factor of five.
export OMP_WAIT_POLICY := PASSIVE

.PHONY: setup demo test slow faults peers engines browser adversary tournament results fuzz hostile kills lerobot check workflows windows resolve wheels ends image site clean

setup: $(VENV)/.done

# torch first and alone, pinned: a CPU build where one can be found, so that nothing pulls gigabytes of CUDA.
# For a GPU: make setup TORCH="torch==2.13.0"
TORCH ?= torch==2.13.0+cpu
$(VENV)/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -c "import torch" 2>/dev/null || PIP_CONSTRAINT= $(BIN)/pip install -q "$(TORCH)" 2>/dev/null \
	  || PIP_CONSTRAINT= $(BIN)/pip install -q "torch==2.13.0" --index-url https://download.pytorch.org/whl/cpu 2>/dev/null \
	  || PIP_CONSTRAINT= $(BIN)/pip install -q "torch==2.13.0"
	$(BIN)/pip install -q -e ".[$(EXTRAS)]"
	touch $@

demo: setup
	$(BIN)/gaponet demo

# Two processes, one test file at a time each; JOBS=0 for one.
JOBS ?= 2
test: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadfile

# Proofs of half a minute and more whose facts have quick tests too: the tutorial on policies, from recordings to a robot.
slow: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow

# Faults injected over a real bus between processes: minutes, on a machine that is otherwise idle.
faults: setup
	$(BIN)/python -m pytest -m faults -rP tests/hw

# At the other end, in environments of their own in ~/.cache/gaponet: programs on the DDS version of Unitree's SDK (Python
# 3.10), rclpy of ROS 2 Jazzy and Kilted (Python 3.12): five minutes.
peers: setup
	$(BIN)/python -m pytest -m peers -s tests/hw

# MuJoCo, mjlab, Isaac Lab and Newton (environments of their own in ~/.cache/gaponet, 16 GB) play exports beside ours:
# half an hour.
engines: setup
	$(BIN)/python -m pytest -m peers -s tests/export

# Chromium looks at gaponet view and at a report (Debian: apt-get install chromium libegl1): two minutes.
browser: setup
	$(BIN)/pip install -q -e ".[$(EXTRAS),film]"
	$(BIN)/python -m pytest -m browser -s tests/report/view

# A million random and adversarial states through controller and limits, in simulated time; then found poses against plans and
# hostile live targets against the fence, judged by MuJoCo: minutes, then half an hour; counts as JSON.
adversary: setup
	OMP_NUM_THREADS=1 $(BIN)/python tests/hw/control/adversary.py --states 1000000
	OMP_NUM_THREADS=1 PYTHONPATH=tests $(BIN)/python tests/hw/control/plan_adversary.py --poses 1000 --seconds 60

# Ten small robots that nobody tuned on, beside the least-squares script: minutes, resumable; exit code 1 where one loses.
tournament: setup
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/tournament.py tournament_work --robots 10 --small

# The numbers of README.md and docs/results.md, one command after the other, resumable: about a day. STEPS="tournament backlash"
# runs only these; STEPS=quick runs the short form of each, an hour; STEPS=--list shows all, and when each ran.
STEPS ?=
results: setup
	$(BIN)/pip install -q "mujoco[sysid]"  # a baseline
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/results.py results_work $(STEPS)

# Changed files at random into everything that reads files: a quarter of an hour; counts as JSON, exit code 1 where one
# ends in anything but one clear error or sane data. FUZZ="--only sage --mutants 1000 --keep failed" looks at one reader.
FUZZ ?=
fuzz: setup
	OMP_NUM_THREADS=1 PYTHONPATH=src:tests $(BIN)/python -m fuzzing $(FUZZ)

# Files of some bytes that ask for gigabytes or for ever, each opened by its command: five minutes, on Linux.
hostile: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow tests/base

# Every command that writes, killed and repeated; those that store data also on full and read-only disks and twice at once:
# an hour; disks need root.
kills: setup
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/kills.py kills_work

# LeRobot 0.6 with our plug-in (Python 3.12, torch; made in ~/.cache/gaponet, 5 GB) on a virtual servo bus: ten minutes.
LEROBOT ?= $(HOME)/.cache/gaponet/lerobot-0.6.1
lerobot: $(LEROBOT)/.done
	OMP_NUM_THREADS=1 $(LEROBOT)/bin/python benchmarks/lerobot_so101.py lerobot_work
$(LEROBOT)/.done: plugins/lerobot_robot_gaponet/pyproject.toml
	python3.12 -m venv $(LEROBOT)
	PIP_CONSTRAINT= $(LEROBOT)/bin/pip install -q "lerobot[dataset,feetech]==0.6.1" -e ".[train,so101,zmq]" -e plugins/lerobot_robot_gaponet
	touch $@

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-forms .github/ISSUE_TEMPLATE/*.yml
	$(BIN)/zizmor --offline --quiet .github/workflows

# What is promised on Windows: from logs to a report.
windows: setup
	$(BIN)/python -m pytest tests/test_api.py tests/base/test_files.py tests/whole/test_windows.py tests/data tests/sim tests/sysid/test_*.py tests/nn $(wildcard tests/evaluation/test_*.py tests/report/test_*.py)

# These three need the package index, and uv from it in .tools.
.tools/.done:
	$(PYTHON) -m venv .tools
	.tools/bin/pip install -q uv
	touch $@

# gaponet with every extra beside LeRobot, mjlab and Isaac Lab, on four systems and Python versions: resolved, not installed.
resolve: .tools/.done
	$(TOOLS) $(PYTHON) .ci/resolve.py

# Wheel and sdist, tried in clean environments outside of the checkout, one for each extra.
wheels: .tools/.done
	$(TOOLS) $(PYTHON) .ci/wheels.py

# The tests with the lowest versions that pyproject.toml allows, and with the newest: half an hour.
TESTS ?= tests
ends: .tools/.done
	for end in lowest-direct highest; do \
	  $(TOOLS) uv venv -q --clear --python $(PYTHON) .ends/$$end && \
	  $(TOOLS) uv pip install -q --python .ends/$$end --resolution $$end -e ".[$(EXTRAS)]" && \
	  OMP_NUM_THREADS=1 .ends/$$end/bin/python -m pytest -n $(JOBS) --dist loadfile $(TESTS) || exit 1; done

# The container of Dockerfile, made and started.
image:
	docker build -t gaponet .
	docker run --rm gaponet --version

# docs/ as a site in site/; a broken link or a name that is not in the package ends the build.
site: setup
	$(BIN)/zensical build --strict --clean

clean:
	rm -rf $(VENV) .tools .ends dist site demo_run kills_work lerobot_work .pytest_cache .ruff_cache .mypy_cache
