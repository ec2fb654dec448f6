# make demo   a virtual environment, the package, and the main job: render, solve, show
# make test   the same environment: lint, format, types, tests
# make test-long  the longest statistics and a whole mission: some minutes more, before a release
# make docs   the site, from docs/: docs/_build/html/index.html; needs no network once it is installed
# make notebooks  the notebooks, opened in the browser
# make bench  the benchmarks behind the figures in the README; DATA=DIR for that on the stereo pairs of a chessboard,
#             GRAPHS=DIR for those on the pose graphs sphere2500 and M3500, MRCLAM=DIR for that on an MR.CLAM dataset

# make fuzz   every parser by guided fuzzing: 20,000 inputs a target; ARGS="team g2o --runs 100000" for some of them
# make search  simulated missions with random faults, on all cores; ARGS="--missions 1000"

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NICE := nice -n 19
REALTIME = $(BIN)/pytest -o cache_dir=$(VENV)/realtime -m realtime
ARGS ?=
DATA ?=
GRAPHS ?=
MRCLAM ?=
# modules are compiled once, not by each of the hundred processes that tests start
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-long lint types unit unit-and-types ordinary realtime docs notebooks bench fuzz search clean

demo: $(VENV)/installed
	$(BIN)/coloc demo --force $(ARGS)

test: lint
	@$(MAKE) --no-print-directory unit-and-types

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/installed-dev
	$(NICE) $(BIN)/mypy

ifeq ($(ARGS),)
# tests in real time go first wherever they want a processor; their lines come when they have ended. What failed is run
# once more: a computer that others use can make a robot late. What fails twice fails.
unit: $(VENV)/installed-dev
	@$(MAKE) --no-print-directory -j2 ordinary realtime

unit-and-types: $(VENV)/installed-dev
	@$(MAKE) --no-print-directory -j3 ordinary realtime types

ordinary: $(VENV)/installed-dev
	$(NICE) $(BIN)/pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder -m "not realtime" tests

realtime: $(VENV)/installed-dev
	@rm -rf $(VENV)/realtime; $(REALTIME) >$(VENV)/realtime.log 2>&1; code=$$?; cat $(VENV)/realtime.log; \
	[ $$code -ne 1 ] || { echo "once more, alone, what failed:"; $(REALTIME) --last-failed; code=$$?; }; exit $$code
else
unit: $(VENV)/installed-dev
	$(BIN)/pytest $(ARGS)

unit-and-types: types unit
endif

test-long: $(VENV)/installed-dev $(VENV)/installed-docs
	$(BIN)/pytest --numprocesses 2 --whole -m long tests
	$(BIN)/pytest --whole tests/online/test_online.py

docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

notebooks: $(VENV)/installed-notebooks
	$(BIN)/python -m jupytext --quiet --to ipynb notebooks/*.py
	$(BIN)/jupyter notebook notebooks

bench: $(VENV)/installed-dev
	$(BIN)/python benchmarks/single_step.py
	$(BIN)/python benchmarks/hallway.py --seeds 40
	$(BIN)/python benchmarks/joint.py
	$(BIN)/python benchmarks/joint.py --images 10 --six-step 50 --far 50 --honesty 200 --speed
	$(BIN)/python benchmarks/leapfrog_ekf.py
	$(BIN)/python benchmarks/relative_pose.py --outliers
	$(BIN)/python benchmarks/frontend.py
	$(BIN)/python benchmarks/clock_offset.py
	$(BIN)/python benchmarks/viewer.py
	$(BIN)/python benchmarks/link.py
	$(BIN)/python benchmarks/online.py
	$(BIN)/python benchmarks/bumps.py
	$(BIN)/python benchmarks/many_runs.py
	$(BIN)/python benchmarks/tracking.py
	$(BIN)/python benchmarks/association.py
	$(BIN)/python benchmarks/team.py
	$(BIN)/python benchmarks/team.py --table
	$(BIN)/python benchmarks/messy.py
	$(BIN)/python benchmarks/nees_interval.py
	$(BIN)/python benchmarks/backend.py $(if $(GRAPHS),--data $(GRAPHS))
ifneq ($(MRCLAM),)
	$(BIN)/python benchmarks/mrclam.py --data $(MRCLAM)
endif
ifneq ($(DATA),)
	$(BIN)/python benchmarks/stereo_board.py --data $(DATA)
	$(BIN)/python benchmarks/calibration.py --data $(DATA)
else
	@echo "benchmarks/stereo_board.py and calibration.py are left out: give the folder of their images with make bench DATA=DIR"
endif

fuzz: $(VENV)/installed-dev
	$(BIN)/pip install --quiet --disable-pip-version-check 'atheris>=3'
	$(BIN)/python -m fuzz.run $(ARGS)

search: $(VENV)/installed-dev
	$(BIN)/python -m coloc_graph.missions.search $(ARGS)

$(VENV)/made:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 15) else \
	"coloc-graph needs CPython 3.11 to 3.14 (GTSAM has wheels for these) and this is %d.%d: " % v + \
	"run again with make PYTHON=/path/to/python3.12")'
	$(PYTHON) -m venv $(VENV)
	@touch $@

KERNEL := setup.py $(wildcard kernel/*)

$(VENV)/installed: $(VENV)/made pyproject.toml $(KERNEL)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/installed-%: $(VENV)/made pyproject.toml $(KERNEL)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch $(VENV)/installed $@

clean:
	rm -rf $(VENV) demo-out docs/_build notebooks/*.ipynb .pytest_cache .mypy_cache .ruff_cache *.egg-info
