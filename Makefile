# make demo   the whole loop: simulate, record, identify, compare      (needs git, make, Python 3.11 or 3.12)
# make test   every check
# make docs   the documentation as a site: build/docs/index.html
# make wheel  the wheel in dist/, installed into an environment of its own and tried there
# make fuzz   ten thousand damaged bags and 300 random logs; FIRST=n, CASES=n and LOGS=n choose which
# make mutants  a hundred random faults put into the code; SEED=n and COUNT=n choose which
# make soak   all nodes among foreign traffic for DURATION seconds
# make bench  speed, compared with plain scripts on the same machine: bench/README.md
# make bench-peers  FIGAROH, mujoco.sysid and plain least squares on the same logs; PROBLEMS and DATA choose which
# make setup  the environment alone, in .venv

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# A sourced ROS installation would mix its libraries with those of the wheels in .venv.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
unexport LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE VIRTUAL_ENV
# Without bytecode every one of the many processes would compile SciPy anew, for seconds.
unexport PYTHONDONTWRITEBYTECODE
# rclpy aborts where it finds neither HOME nor a place for its log.
export ROS_LOG_DIR ?= $(CURDIR)/log/ros
# The matrices are small: threads of BLAS only compete with the nodes for the cores.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: setup setup-dev demo test pytest docs wheel fuzz mutants soak bench bench-peers lint ruff mypy clean

setup: $(VENV)/.installed

setup-dev: $(VENV)/.installed-dev

demo: setup
	$(BIN)/symbid demo --overwrite

# Mypy uses one processor: the tests run beside it.
test: ruff
	@$(MAKE) --no-print-directory --jobs=2 mypy pytest

pytest: setup-dev
	$(BIN)/python -m pytest -n 3 --dist loadfile

FIRST ?= 0
CASES ?= 10000
LOGS ?= 300
docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going docs build/docs
	@echo "build/docs/index.html"

# The wheel, and a clean environment in which its command works.
wheel: $(BIN)/python
	rm -rf build/wheel
	$(PIP) wheel --quiet --no-deps --wheel-dir dist .
	$(BIN)/python -m venv build/wheel
	build/wheel/bin/pip --disable-pip-version-check install --quiet \
	    -c requirements.txt -c requirements-pypi.txt "$$(ls -t dist/*.whl | head -1)[bags]"
	cd build/wheel && bin/symbid --version && bin/symbid identify --help >/dev/null

fuzz: setup-dev
	$(BIN)/python test/support/bag_fuzz.py --first $(FIRST) --cases $(CASES)
	$(BIN)/python test/support/log_fuzz.py --first $(FIRST) --cases $(LOGS)

SEED ?= 0
COUNT ?= 100
AGAIN ?=
mutants: $(VENV)/.installed-mutants
	$(BIN)/python test/support/mutants.py --seed $(SEED) --count $(COUNT) $(if $(AGAIN),--again)

DURATION ?= 300
soak: setup-dev
	$(BIN)/python test/support/soak.py --duration $(DURATION)

bench: setup-dev
	$(BIN)/python bench/run_all.py

PROBLEMS ?= ur5 anymal
DATA ?=
PEERS := build/peers
bench-peers: setup-dev $(PEERS)/.installed
	$(BIN)/python bench/peers.py --python $(PEERS)/bin/python --problems $(PROBLEMS) $(if $(DATA),--data $(DATA))

$(PEERS)/.installed: bench/peers/requirements.txt | $(BIN)/python
	$(BIN)/python -m venv $(PEERS)
	$(PEERS)/bin/pip --disable-pip-version-check install --quiet -r bench/peers/requirements.txt
	@touch $@

lint: ruff mypy

ruff: setup-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

mypy: setup-dev
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist install log demo *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis .mutants

# The interpreters are tried by running them: a shim can be there and fail.
$(BIN)/python:
	@for python in python3 python3.12 python3.11; do \
	    if $$python -c 'import ensurepip, sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' \
	        >/dev/null 2>&1; then \
	        echo "creating $(VENV) with $$($$python --version)"; \
	        exec $$python -m venv --clear $(VENV); \
	    fi; \
	done; \
	echo "make: no Python 3.11 or 3.12 with venv found; install python3.12 and python3.12-venv" >&2; \
	exit 1

# The extras of pyproject.toml say what is installed, these lists in which version. Most of what is
# installed is never imported: compiling it all would double the time.
INSTALL := $(PIP) install --quiet --no-compile --no-build-isolation \
    -c requirements.txt -c requirements-pypi.txt -c requirements-ros.txt -c requirements-docs.txt

$(VENV)/.installed: pyproject.toml requirements.txt requirements-pypi.txt requirements-ros.txt setup.py setup.cfg | $(BIN)/python
	$(PIP) install --quiet pip==26.3 setuptools==79.0.1
	PYTHONWARNINGS=ignore $(INSTALL) --editable '.[ros,sim]'
	$(BIN)/python -c 'from symbid_ros.dynamics import inertial_rows; inertial_rows.compile_kernel()'
	@touch $@

$(VENV)/.installed-dev: requirements-dev.txt requirements-docs.txt $(VENV)/.installed
	$(INSTALL) 'symbid_ros[study,dask,docs]' -r requirements-dev.txt
	@touch $@

$(VENV)/.installed-docs: requirements-docs.txt $(VENV)/.installed
	$(INSTALL) 'symbid_ros[docs]'
	@touch $@

$(VENV)/.installed-mutants: requirements-mutants.txt $(VENV)/.installed-dev
	$(PIP) install --quiet --no-compile -r requirements-mutants.txt
	@touch $@
