# The project's commands. CI and pre-commit call the same targets, so that each line stands once, here.

PYTHON ?= python3
VENV ?= .venv
CONFIG ?= configs/small.yaml
# The network of make train: never one of those that the project ships, which git would show as changed.
NAME ?= my_$(basename $(notdir $(CONFIG)))
# More arguments for pip, for example the package index of CPU-only PyTorch wheels.
PIP_ARGS ?=

BIN := $(VENV)/bin
# Built by pip where there is a C++ compiler.
KERNELS := $(wildcard lanenet/perception/*.hpp lanenet/perception/*/_kernels.cpp)
PIP := $(BIN)/python -m pip install --disable-pip-version-check $(PIP_ARGS) -c constraints.txt
# Tests run on this many cores. Each process takes over a gigabyte, hence the bound for large machines.
TEST_PROCESSES ?= auto
# Shapes and types of arguments are checked at run time in tests, and only there. A process computes with one
# thread, so that the processes leave each other their cores. Neighbouring tests share a process and its
# fixtures, until a process that has none left takes over some of another one's. Compiled modules are kept, even
# where the environment forbids it (as many containers do): else each process, and each program that a test
# starts, compiles them all again. Each skip gives its reason, and a target whose tests were all skipped fails.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest \
  --jaxtyping-packages=lanenet,datagen,beartype.beartype -rs --fail-on-skips all \
  --numprocesses $(TEST_PROCESSES) --maxprocesses 4 --dist worksteal

.PHONY: help train general install env test test-data test-slow test-base-install chain traps ablation fit-lane fit-labels left-out leaderboard judge screenshots fleet golden golden-renew donkeycar arm release pictures wheels neutral faults check format format-check lint types imports docs figures links bench clean

help:
	@echo "make train        environment, then a network from nothing by $(CONFIG), into checkpoints/$(NAME)/"
	@echo "make general      the network for any car: simulated drives, and real ones of LIBRARY=drives.sqlite; hours"
	@echo "make install      environment for mapping and training in $(VENV)"
	@echo "make test         environment for developers, then the fast tests"
	@echo "make test-data    the fast tests that need real drives (LANENET_SHARED_DATA)"
	@echo "make test-slow    the tests that take long, and further cases of fast ones"
	@echo "make test-base-install  the wheel and the source archive in empty environments, with every Python there is"
	@echo "make chain        from simulate to detect by the command line, kills in between; two steps of all but one config; two processes"
	@echo "make ablation     what parts of the lane filter are worth, on 500 simulated drives (goes on where it stopped)"
	@echo "make fit-lane     the numbers of the lane filter, from simulated drives with their truth (goes on where it stopped)"
	@echo "make traps        maps of drives that are hard to map, of one KIND (goes on where it stopped), and broken maps"
	@echo "make fit-labels   the model of label errors, from drives of four kinds with their truth; hours"
	@echo "make left-out     the general network on each real drive, without it and tuned to it (goes on where it stopped)"
	@echo "make leaderboard  all detectors ranked by left-out track, from what make left-out measured"
	@echo "make judge        both networks and all baselines on 160 roads in closed loop (goes on where it stopped)"
	@echo "make screenshots  the report pages on a phone, in light and dark, into runs/screenshots (needs chromium)"
	@echo "make fleet        drives on a Ray cluster whose nodes are killed, against one process"
	@echo "make golden       two drives from recording to detections, against what they gave before"
	@echo "make golden-renew expect what they give now, and print what changed (on purpose only)"
	@echo "make donkeycar    the pilot in donkeycar 5.3's own vehicle, driven from its own page (needs python3.11)"
	@echo "make arm          the base installation on 64-bit Arm, emulated, against this machine (root, Debian)"
	@echo "make pictures     the moving picture of the README, from a recorded drive (LANENET_SHARED_DATA or DRIVE, LANE_WIDTH, SHOWN)"
	@echo "make release      source archive and wheel of this version into dist/ (needs g++)"
	@echo "make wheels       wheels for x86-64 and 64-bit Arm into dist/ (needs g++ and g++-aarch64-linux-gnu)"
	@echo "make neutral      times of neutral on an emulated bus, for the tables of the documentation (touches no car; 40 min)"
	@echo "make faults       outages of an emulated bus, late and hanging cameras, wrong settings: a table (10 min)"
	@echo "make docs         the documentation as a site into site/; any broken link or warning fails it"
	@echo "make figures      draw frames, windows and lengths anew, and the board to print, into docs/"
	@echo "make links        ask for every address that the documents name (needs the network)"
	@echo "make check        format, lint, types, import rules, fast tests"
	@echo "make format       rewrite the code in the project's format"
	@echo "make bench        time the stages that run on the car, on this machine"
	@echo "make env          environment for developers in $(VENV)"
	@echo "make clean        remove caches and what was built; keeps runs/, checkpoints/ and $(VENV)"

train: $(VENV)/.stamp-train
	$(BIN)/lanenet train $(CONFIG) name=$(NAME)

# Real drives are those of a library (lanenet drives), with the maps of lanenet label-all where LABELLED says so; all
# of a track in one part. GENERAL adds arguments, such as data.library.weight=0.3 or data.library.split=train.
LIBRARY ?=
LABELLED ?=
general: $(VENV)/.stamp-train
	$(BIN)/lanenet train configs/general.yaml name=$(if $(LIBRARY),general-real,my_general) $(if $(LIBRARY),data.library.file=$(LIBRARY) \
	  $(if $(LABELLED),data.library.labelled=$(LABELLED))) $(GENERAL)

install: $(VENV)/.stamp-train

env: $(VENV)/.stamp-dev

test: $(VENV)/.stamp-dev
	$(PYTEST) -m "not slow"

# Real drives are not part of the repository: LANENET_SHARED_DATA names their folder.
NEED_REAL_DRIVES = @test -d "$(LANENET_SHARED_DATA)" || \
  { echo "error: needs real drives, but LANENET_SHARED_DATA names no folder of them" >&2; exit 1; }

# What Donkeycar is needed for has a target of its own.
test-data: $(VENV)/.stamp-dev
	$(NEED_REAL_DRIVES)
	$(PYTEST) --fail-on-skips any -m "data and not slow" --ignore tests/contracts/test_donkeycar.py

test-slow: $(VENV)/.stamp-dev
	$(PYTEST) -m slow

# What the car installs, in an empty environment; fetches packages. One process, so that the release is built once.
test-base-install: $(VENV)/.stamp-dev
	$(PYTEST) -m slow --dist loadfile tests/contracts/test_base_install.py

# Each file stays in one process, for its fixtures. AlexNet takes its two steps by paper_split.yaml; by its own
# config in make test-slow.
chain: $(VENV)/.stamp-dev
	$(PYTEST) -m slow --dist loadfile --deselect "tests/contracts/test_configs.py::test_a_training_run_takes_two_steps[alexnet.yaml]" \
	  tests/sim/test_chain.py tests/sim/test_train_own_drive.py \
	  tests/contracts/test_configs.py tests/unit/learn/test_learn_parallel.py::test_two_processes_train_as_one

# Roads take most of an hour on one core; KIND is another one of trap_drives.py: tiles, office, mats, floors, shifted.
# TRAPS adds arguments, such as --drives 0:20 --processes 2.
KIND ?= roads
FOLDER ?= runs/traps/$(KIND)
traps: $(VENV)/.stamp-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/bench/bench_traps.py --kind $(KIND) --folder $(FOLDER) $(TRAPS)
	OMP_NUM_THREADS=1 $(BIN)/python tests/bench/bench_broken_maps.py --folder $(FOLDER)

# 500 drives take 20 minutes on one core; goes on where it stopped. ABLATION adds arguments, such as --processes 2.
ablation: $(VENV)/.stamp-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/bench/bench_ablation.py --folder runs/ablation $(ABLATION)

# Half an hour on one core; goes on where it stopped. FIT adds arguments, such as --drives 100.
fit-lane: $(VENV)/.stamp-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/bench/fit_lane.py --folder runs/fit-lane $(FIT)

# Goes on where it stopped; FIT_KINDS and TRAPS narrow it.
FIT_KINDS ?= roads tiles office mats
fit-labels: $(VENV)/.stamp-dev
	$(PIP) -e '.[fit]'
	for kind in $(FIT_KINDS); do \
	  OMP_NUM_THREADS=1 $(BIN)/python tests/bench/bench_traps.py --kind $$kind --folder runs/labels/$$kind $(TRAPS) && \
	  OMP_NUM_THREADS=1 $(BIN)/python tests/bench/label_tables.py runs/labels/$$kind --out runs/labels/$$kind/tables --spoilt 2 \
	    || exit 1; done
	$(BIN)/python tests/bench/fit_label_error.py $(FIT_KINDS:%=runs/labels/%/tables) --out datagen/quality/label_error.npz

# Half an hour on one core, once make general has made its drives; needs the real ones of tests/configs/tubs.yaml.
# LEFT_OUT adds arguments, such as --start checkpoints/mine.
left-out: $(VENV)/.stamp-train
	$(NEED_REAL_DRIVES)
	OMP_NUM_THREADS=1 $(BIN)/python tests/bench/bench_left_out.py --folder runs/left-out --data "$(LANENET_SHARED_DATA)" $(LEFT_OUT)

# From the table of the line above, or from its page.
leaderboard: $(VENV)/.stamp-train
	$(BIN)/python tests/bench/bench_leaderboard.py --folder runs/left-out

# Two hours on two cores; JUDGE adds arguments, such as --workers 8. Of the road cameras each competition has its
# own, hence --any-camera for the network that was trained with one.
JUDGED := truth,network=checkpoints/general,network=checkpoints/small,lane-filter,hough,hough-value,painter
judge: $(VENV)/.stamp-train
	OMP_NUM_THREADS=1 $(BIN)/lanenet judge --config configs/judge/competition.yaml --detectors $(JUDGED) \
	  --any-camera --out runs/competition $(JUDGE)
	OMP_NUM_THREADS=1 $(BIN)/lanenet judge --config configs/judge/across.yaml --detectors $(JUDGED) \
	  --any-camera --out runs/across $(JUDGE)

# Needs chromium; into runs/screenshots, to be looked at.
screenshots: $(VENV)/.stamp-dev
	LANENET_SCREENSHOTS=$(abspath runs/screenshots) $(PYTEST) tests/contracts/test_pages_in_browser.py

fleet: $(VENV)/.stamp-dev
	$(PYTEST) -m slow --numprocesses 0 tests/sim/test_fleet_on_a_cluster.py

# With real drives none may be skipped.
golden: $(VENV)/.stamp-dev
	$(PYTEST) $(if $(LANENET_SHARED_DATA),--fail-on-skips any) tests/golden

golden-renew: $(VENV)/.stamp-dev
	$(BIN)/python tests/golden/renew.py

# Donkeycar pins Python and NumPy, hence an environment of its own. Another one: LANENET_DONKEYCAR=FOLDER make donkeycar
LANENET_DONKEYCAR ?= $(abspath .venv-donkeycar)
donkeycar: $(VENV)/.stamp-dev $(LANENET_DONKEYCAR)/.stamp
	LANENET_DONKEYCAR=$(LANENET_DONKEYCAR) $(PYTEST) --numprocesses 0 tests/contracts/test_donkeycar.py

$(LANENET_DONKEYCAR)/.stamp: contrib/donkeycar.txt pyproject.toml $(KERNELS)
	@command -v python3.11 >/dev/null || { echo "error: no python3.11 found, which donkeycar 5.3 needs" >&2; exit 1; }
	python3.11 -m venv $(LANENET_DONKEYCAR)
	$(LANENET_DONKEYCAR)/bin/python -m pip install --disable-pip-version-check $(PIP_ARGS) -c contrib/donkeycar.txt donkeycar -e .
	touch $@

# Maps the drive first, which takes some minutes, unless that was done before.
DRIVE ?= $(LANENET_SHARED_DATA)/donkey_circuit
LANE_WIDTH ?= 59
SHOWN ?= 700:859
pictures: $(VENV)/.stamp-train
	$(if $(filter file,$(origin DRIVE)),$(NEED_REAL_DRIVES))
	test -e runs/pictures/$(notdir $(DRIVE))/map.yaml || \
	  $(BIN)/lanenet map $(DRIVE) --lane-width $(LANE_WIDTH) --out runs/pictures/$(notdir $(DRIVE))
	$(BIN)/python contrib/pictures.py runs/pictures/$(notdir $(DRIVE)) docs/images/drive.webp --frames $(SHOWN)

release: $(VENV)/.stamp-dev
	PYTHON=$(abspath $(BIN)/python) contrib/release dist

wheels: $(VENV)/.stamp-train
	PYTHON=$(abspath $(BIN)/python) contrib/wheel x86_64 dist
	PYTHON=$(abspath $(BIN)/python) contrib/wheel aarch64 dist

# Needs debootstrap, qemu-user-static and g++-aarch64-linux-gnu, and root.
arm: $(VENV)/.stamp-train
	PYTHON=$(abspath $(BIN)/python) contrib/arm/prove

# Twenty times each; for true times leave the machine alone meanwhile. Needs g++.
neutral: $(VENV)/.stamp-dev
	$(PYTEST) -s --numprocesses 0 tests/sim/test_neutral_times.py
	PYTHONPATH=tests/sim:tests/support OMP_NUM_THREADS=1 $(BIN)/python tests/sim/outages.py 20

# Less than ten minutes; FAULTS is the number of repetitions.
FAULTS ?= 5
faults: $(VENV)/.stamp-dev
	PYTHONPATH=tests/sim:tests/support OMP_NUM_THREADS=1 $(BIN)/python tests/sim/faults.py $(FAULTS)

check: format-check lint types imports test

format: $(VENV)/.stamp-dev
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

format-check: $(VENV)/.stamp-dev
	$(BIN)/ruff format --check

lint: $(VENV)/.stamp-dev
	$(BIN)/ruff check

types: $(VENV)/.stamp-dev
	$(BIN)/mypy

imports: $(VENV)/.stamp-dev
	$(BIN)/lint-imports

# Nothing is fetched. The warning that is switched off advertises another generator.
docs: $(VENV)/.stamp-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

figures: $(VENV)/.stamp-dev
	$(BIN)/python tests/bench/draw_hypotheses.py docs/images/hypotheses.png
	$(BIN)/python contrib/docs/figures.py docs/images/frames
	for paper in a4 letter; do $(BIN)/lanenet calibrate print --paper $$paper --out docs/print/board-$$paper.pdf; done

links: $(VENV)/.stamp-dev
	$(BIN)/python contrib/docs/links.py

bench: $(VENV)/.stamp-train
	mkdir -p runs
	$(BIN)/lanenet bench --model checkpoints/small --out runs/bench.json

clean:
	rm -rf site build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find lanenet datagen tests -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is written only when pip has finished, so that an interrupted installation is taken up again.
$(VENV)/.stamp-train: pyproject.toml constraints.txt $(KERNELS) | $(BIN)/python
	$(PIP) -e '.[train,viz]'
	touch $@

# The developers' extra contains the other two.
$(VENV)/.stamp-dev: pyproject.toml constraints.txt $(KERNELS) | $(BIN)/python
	$(PIP) -e '.[dev]'
	# Most of numba's loops are compiled once here, and not by each process of the tests at the same time.
	$(BIN)/python -c "from datagen.compile_ahead import compile_ahead; compile_ahead().join()"
	touch $(VENV)/.stamp-train $@

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || \
	  { echo "error: no '$(PYTHON)' found; lanenet needs Python 3.11 or newer (make PYTHON=...)" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: lanenet needs Python 3.11 or newer, '$(PYTHON)' is $$($(PYTHON) --version 2>&1);" \
	    "name another one, as in: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { rm -rf $(VENV); \
	    echo "error: '$(PYTHON) -m venv' failed; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
