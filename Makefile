# `make demo` and `make test` each set up everything they need on a fresh machine.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test heavy ros2-peers device-peers wheels bundle lint types layers docs bench format clean

# The stamp is older than the pins whenever these change, so a stale .venv is brought up to date.
.venv/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "rtee needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version). Try: make PYTHON=python3.12 …"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[all]" --group dev
	$(BIN)/python -m compileall -q rtee
	@touch $@

demo: .venv/.ready
	$(BIN)/python examples/demo.py

# Three processes: half of the tests wait for simulated wires and for a browser. These are real, so
# that a test may fail when the computer is busy: it is run once more, and named in the summary.
# What comes before takes one processor each, so it is done at the same time.
test: .venv/.ready
	@$(MAKE) --no-print-directory --jobs 3 --output-sync=target \
		lint types layers .ros2-peers/.ready .device-peers/.ready
	$(BIN)/python -m pytest -n 3 --reruns 1 --rerun-show-tracebacks -r fEsR --durations 25

# Whole experiments in dynamics, too long for every commit.
heavy: .venv/.ready
	RTEE_HEAVY=1 $(BIN)/python -m pytest -v -m heavy -n 2 --timeout 600

# Other implementations of ROS 2 over Zenoh, which tests run against in processes of their own.
.ros2-peers/.ready: tests/ros2/peers/requirements.txt .venv/.ready
	$(BIN)/python -m pip install --quiet --upgrade --no-deps --target .ros2-peers -r $<
	@touch $@

# Device makers' own software, which tests let drive the emulators.
.device-peers/.ready: tests/drivers/peers/requirements.txt .venv/.ready
	$(BIN)/python -m pip install --quiet --upgrade --no-deps --target .device-peers -r $<
	@touch $@

device-peers: .device-peers/.ready
	$(BIN)/python -m pytest -v tests/drivers/feetech/test_feetech_clients.py tests/drivers/ability_hand/test_ability_hand_client.py

ros2-peers: .ros2-peers/.ready
	$(BIN)/python -m pytest -v tests/ros2/test_ros2_peers.py

# The wheel as a user gets it: in an empty environment of each Python there is, and on ARM.
wheels: .venv/.ready
	RTEE_WHEELS=1 $(BIN)/python -m pytest -v tests/install \
		tests/deploy/test_bundle.py tests/deploy/test_container.py

# For a robot PC without a network: make bundle FOR="--python 3.12 --platform aarch64"
bundle: .venv/.ready
	$(BIN)/python deploy/bundle.py $(FOR)

lint: .venv/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: .venv/.ready
	$(BIN)/mypy

layers: .venv/.ready
	$(BIN)/lint-imports

format: .venv/.ready
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: .venv/.ready
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --group docs
	$(BIN)/mkdocs build --strict

bench: .venv/.ready
	for name in extract loop latency log drivers codecs gui simulation; do \
		$(BIN)/python benchmarks/$$name.py; \
	done

clean:
	rm -rf .venv site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
