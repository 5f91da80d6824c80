# Two commands: `make demo` shows the main job, `make test` runs all tests. Both set up the same virtual environment.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SYSTEM := $(VENV)/.system
DEMO := runs/demo

.PHONY: demo test robosuite ros2 lint docs examples results bench clean help

help: ## this list
	@grep -hE '^[a-z0-9]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

demo: $(INSTALLED) ## 100 robots, 10 humans: C.U.R. against behaviour cloning, same seed
	rm -rf $(DEMO)
	$(BIN)/tutelage run Walker2d --priority C. --label "Behaviour cloning" --steps 3000 --out $(DEMO)/behaviour-cloning
	$(BIN)/tutelage run Walker2d --priority C.U.R. --steps 3000 --overlap --out $(DEMO)/cur
	$(BIN)/tutelage report $(DEMO)/behaviour-cloning $(DEMO)/cur

test: $(INSTALLED) $(SYSTEM) ## all tests
	$(BIN)/pytest -n auto --dist loadfile

# robosuite needs numpy 1, so it has an environment of its own.
robosuite: ## tests of the extra robosuite
	$(PYTHON) -m venv .venv-robosuite
	.venv-robosuite/bin/pip install -q --disable-pip-version-check "$$(grep ^torch== constraints-robosuite.txt)"
	.venv-robosuite/bin/pip install -q --disable-pip-version-check -c constraints-robosuite.txt -e '.[robosuite]' pytest hypothesis
	.venv-robosuite/bin/pytest tests/envs/test_robosuite_fleet.py

# ROS 2 Jazzy from PyPI, as wheels for Linux and Python 3.11 to 3.13. Connectivity stands on its own, so no PyTorch; all that is
# installed is listed.
ros2: ## tests of the ROS 2 proxy with real ROS 2 nodes
	$(PYTHON) -m venv .venv-ros2
	.venv-ros2/bin/pip install -q --disable-pip-version-check --no-deps -r constraints-ros2.txt -e .
	.venv-ros2/bin/pytest --confcutdir=tests/sgc tests/sgc/proxies/test_rclpy*.py

lint: $(INSTALLED) ## ruff, mypy, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

examples: $(INSTALLED) ## the code of the README and the examples
	$(BIN)/python tests/run_examples.py

docs: $(INSTALLED) ## the documentation as a web site, in site/
	$(BIN)/pip install -q -c constraints.txt -e '.[docs]'
	$(BIN)/python -m tutelage.experiments.tables results/fleet --check
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

results: $(INSTALLED) ## the tables and figures of docs/results.md, from results/
	$(BIN)/python -m tutelage.experiments.tables results/fleet

bench: $(INSTALLED) ## the speed claims, as ratios on this machine
	$(BIN)/python -m benchmarks

clean: ## remove the environment and the demo's runs
	rm -rf $(VENV) .venv-robosuite .venv-ros2 $(DEMO) site

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --disable-pip-version-check "$$(grep ^torch== constraints.txt)"
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

# Rendering tests need an OpenGL library without a screen, network tests need tools for namespaces and address translation,
# tests of the console's page need Chromium.
# Installed where that is allowed (root and apt); elsewhere the tests that need them skip and say so. Only in CI: an SSH server,
# which would begin to listen on a machine of one's own, and a compiler for a second DDS vendor.
$(SYSTEM): $(INSTALLED)
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! $(BIN)/python -c "import ctypes; ctypes.CDLL('libEGL.so.1')" 2>/dev/null; then \
	  apt-get update -qq && apt-get install -qq -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri libosmesa6 >/dev/null; fi
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! { command -v ip && command -v nft; } >/dev/null; then \
	  apt-get update -qq && apt-get install -qq -y --no-install-recommends iproute2 nftables >/dev/null; fi
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! command -v chromium >/dev/null; then \
	  apt-get update -qq && apt-get install -qq -y --no-install-recommends chromium fonts-dejavu-core >/dev/null; fi
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && [ -n "$$CI" ] && ! command -v sshd >/dev/null; then \
	  apt-get update -qq && apt-get install -qq -y --no-install-recommends openssh-client openssh-server >/dev/null \
	  || echo "no SSH server in this distribution: the published timing over SSH is skipped"; fi
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && [ -n "$$CI" ] && ! dpkg -s g++ libfastrtps-dev >/dev/null 2>&1; then \
	  apt-get update -qq && apt-get install -qq -y --no-install-recommends g++ libfastrtps-dev libfastcdr-dev >/dev/null \
	  || echo "no Fast DDS in this distribution: the test with a second DDS vendor is skipped"; fi
	touch $@
