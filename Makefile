# `make demo` and `make test` each set up everything they need on a fresh machine.
PYTHON ?= python3
BIN := .venv/bin
TEST_PROCESSES ?= 6
# The processes learn of the tests file by file, so a percentage of them would be wrong.
TOGETHER = -n $(TEST_PROCESSES) -o console_output_style=classic

# Where it is set, each process would compile all modules anew.
export PYTHONDONTWRITEBYTECODE :=

# A virtual environment names its own folder: that of a clone that was moved is made anew.
ifneq ($(wildcard .venv/.pip),)
ifeq ($(shell grep -sF '$(CURDIR)/.venv' .venv/bin/activate),)
$(info This folder was moved; its .venv is made anew.)
$(shell rm -rf .venv)
endif
endif

.PHONY: demo quick test tests times heavy ros2-peers device-peers lerobot wheels bundle checks lint types layers docs bench format clean

.venv/.pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "rtee needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version). Try: make PYTHON=python3.12 …"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	@touch $@

# The stamp is older than the pins whenever these change, so a stale .venv is brought up to date.
.venv/.ready: pyproject.toml constraints.txt | .venv/.pip
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[all]" --group dev
	@# Who imports a module first compiles it; most modules of libraries are never imported.
	@touch $@

demo: .venv/.ready
	$(BIN)/python examples/demo.py

# What a developer runs at each step: the checks, and the files of tests that take no longer than a
# moment (tests/long_files.txt has the others).
quick: .venv/.ready
	@$(MAKE) --no-print-directory --jobs 3 --output-sync=target checks
	RTEE_QUICK=1 $(BIN)/python -m pytest -q $(TOGETHER) -n 3

# Types, layers and lint beside the tests, which wait for wires, sockets and a browser.
test:
	@$(MAKE) --no-print-directory --jobs 5 checks tests

tests: .venv/.ready .ros2-peers/.ready .device-peers/.ready
	$(BIN)/python -m pytest $(TOGETHER) --durations 25

# How long the files of tests take, by which they are shared out: the longest first.
times: .venv/.ready .ros2-peers/.ready .device-peers/.ready
	$(BIN)/python -m pytest -q $(TOGETHER) --junitxml=.times.xml
	$(BIN)/python tests/long_files.py .times.xml && rm .times.xml

# What is too long for every commit: whole experiments in dynamics, and every hand where a test of
# each commit takes one of each kind.
heavy: .venv/.ready .device-peers/.ready .rosidl/.ready
	RTEE_HEAVY=1 $(BIN)/python -m pytest -v -m heavy -n 2

# Other implementations of ROS 2 over Zenoh, which tests run against in processes of their own.
.ros2-peers/.ready: tests/ros2/peers/requirements.txt | .venv/.pip
	$(BIN)/python -m pip install --quiet --upgrade --no-deps --target .ros2-peers -r $<
	@touch $@

# What makes the messages of ROS 2, as a judge of our hashes: into a prefix, since it has files beside its modules.
.rosidl/.ready: tests/ros2/peers/rosidl.txt .venv/.ready
	$(BIN)/python -m pip install --quiet --no-deps --ignore-installed --prefix .rosidl -r $<
	@touch $@

# Software by device makers and others, which tests let drive the emulators, each in a folder of its own.
.device-peers/.ready: tests/drivers/peers/peers.toml | .venv/.pip
	$(BIN)/python tests/drivers/peers/install.py .device-peers
	@touch $@

device-peers: .device-peers/.ready
	RTEE_HEAVY=1 $(BIN)/python -m pytest -v tests/drivers/feetech/test_feetech_clients.py \
		tests/drivers/ability_hand/test_ability_hand_client.py tests/drivers/inspire_rh56/test_inspire_rh56_clients.py

# LeRobot with PyTorch, several gigabytes: it judges the datasets, trains on them and moves a hand.
.lerobot/.ready: integrations/lerobot/pyproject.toml .venv/.ready
	$(PYTHON) -m venv .lerobot
	.lerobot/bin/python -m pip install --quiet --editable ".[retarget]" --editable integrations/lerobot
	@touch $@

lerobot: .lerobot/.ready
	@# Training has no end of five minutes.
	RTEE_HEAVY=1 $(BIN)/python -m pytest -v -o faulthandler_timeout=0 tests/docs/test_lerobot_page.py

ros2-peers: .venv/.ready .ros2-peers/.ready
	$(BIN)/python -m pytest -v tests/ros2/test_ros2_peers.py

# The wheel as a user gets it: in an empty environment of each Python there is, and on ARM.
wheels: .venv/.ready
	@# On a busy computer, installing everything takes longer than five minutes.
	RTEE_WHEELS=1 $(BIN)/python -m pytest -v -o faulthandler_timeout=0 -o timeout=3600 tests/install \
		tests/deploy/test_bundle.py tests/deploy/test_container.py

# For a robot PC without a network: make bundle FOR="--python 3.12 --platform aarch64"
bundle: .venv/.ready
	$(BIN)/python deploy/bundle.py $(FOR)

checks: lint types layers

# The tests come first: they leave a processor idle now and then, which is enough for these.
GENTLY := nice -n 10

lint: .venv/.ready
	$(GENTLY) $(BIN)/ruff format --check .
	$(GENTLY) $(BIN)/ruff check .

PROGRAMS = $(addprefix examples/,batch.py compose.py jaw_driver.py live_plot.py notebook.py offline.py pick_and_act.py \
	teleoperate.py test_picking.py to_pandas.py two_hands.py)

types: .venv/.ready
	$(GENTLY) $(BIN)/mypy
	$(GENTLY) $(BIN)/mypy --strict $(PROGRAMS)

# The same programs by Pyright, which npm fetches; matplotlib and pandas are not typed to its liking.
pyright: .venv/.ready
	npx --yes pyright -p examples

layers: .venv/.ready
	$(GENTLY) $(BIN)/lint-imports
	$(GENTLY) $(BIN)/deptry rtee

format: .venv/.ready
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: .venv/.ready
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --group docs
	$(BIN)/zensical build --strict --clean

bench: .venv/.ready
	for name in extract loop latency log drivers codecs gui simulation; do \
		$(BIN)/python benchmarks/$$name.py; \
	done

clean:
	rm -rf .venv site .cache .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
