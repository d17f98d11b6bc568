# Each target sets up what it needs; a machine with Python 3.11 or newer and make is enough.
PYTHON ?= python3
VENV := .venv
READY := $(VENV)/.ready
# set in many containers; each of a hundred processes would then compile all modules that it imports
export PYTHONDONTWRITEBYTECODE :=
# in the order of tests/conftest.py
WORKERS := -n logical --no-loadscope-reorder

.PHONY: leaderboard policies test suite test-more test-long test-lowest test-versions package lint bench mutants fuzz kills \
	docs results results-check clean

# the run of the README's table, with its arithmetic; the comparison of policies, which uses one core, runs beside it
leaderboard: BOARD := out/leaderboard
leaderboard: $(READY)
	@mkdir -p $(BOARD)
	export PYTHONDONTWRITEBYTECODE= $$($(VENV)/bin/python -m studies.arithmetic); \
	$(VENV)/bin/road-recon policies --quick --out $(BOARD) >$(BOARD)/policies.txt 2>$(BOARD)/policies.log & \
	$(VENV)/bin/road-recon leaderboard --board new_road --seeds 2 --out $(BOARD) && { wait $$! || { cat $(BOARD)/policies.log; exit 1; }; } && cat $(BOARD)/policies.txt

policies: $(READY)
	$(VENV)/bin/road-recon policies --out out/policies

# side by side: mypy uses one core; which kept figures are not of today's program is a list, no failure
test: $(READY)
	$(MAKE) --jobs=2 lint suite
	@$(VENV)/bin/python -m studies.results check || true

# the figures of README and docs that are not of today's program, made again; NAMES="field bench" for some, JOBS=2
# on two cores
results: JOBS := 1
results: $(READY)
	$(VENV)/bin/python -m studies.results make $(NAMES) --jobs $(JOBS)

results-check: $(READY)
	$(VENV)/bin/python -m studies.results check $(NAMES)

suite: $(READY)
	$(VENV)/bin/pytest $(WORKERS)

test-more: $(READY)
	$(VENV)/bin/pytest -m "(costly or processes) and not slow" $(WORKERS)

test-long: test-more
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[agents]'
	$(VENV)/bin/pytest -m "not slow" $(WORKERS) tests/integration/test_rl_libraries.py tests/integration/test_episodes.py
	$(VENV)/bin/pytest -m slow -s
	ROADRECON_EXAMPLES=20 $(VENV)/bin/pytest -m hypothesis

test-lowest:
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/pip install --quiet --constraint constraints-lowest.txt --editable '.[test]'
	.venv-lowest/bin/pytest -m "not slow and not processes" $(WORKERS) tests/unit

# on each interpreter that is at hand, without torch: tests that need it skip themselves
VERSIONS ?= python3.12 python3.13
test-versions: $(addprefix test-,$(VERSIONS))

test-python%:
	@if ! python$* -c '' 2>/dev/null; then echo "python$*: not at hand, skipped"; exit 0; fi; \
	set -e; python$* -m venv .venv-$*; \
	.venv-$*/bin/pip install --quiet --constraint constraints.txt --editable '.[test-without-torch]'; \
	.venv-$*/bin/pytest -m "not slow and not processes" $(WORKERS)

package: $(READY)
	$(VENV)/bin/pip install --quiet --constraint constraints.txt build
	$(VENV)/bin/python tests/package.py

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

bench: $(READY)
	$(VENV)/bin/python -m studies.bench

mutants: $(READY)
	$(VENV)/bin/python tests/mutants.py

# ten minutes of the processor for each reader; SECONDS=20 for less, JOBS=16 on as many cores
fuzz: SECONDS := 600
fuzz: JOBS := 1
fuzz: $(READY)
	$(VENV)/bin/python tests/fuzz.py $(SECONDS) $(JOBS)

# processes of every stage of a run are killed, and it is resumed; KILLS=20 for more
kills: KILLS := 5
kills: $(READY)
	$(VENV)/bin/python tests/kills.py $(KILLS)

docs: $(READY)
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict

# the import writes the bytecode of what estimators import: in their sandbox they cannot
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed")'
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/pip install --quiet --no-compile --constraint constraints.txt --editable '.[test]'
	$(VENV)/bin/python -c 'import estimators.registry, leaderboard.commands.board, torch'
	touch $@

clean:
	rm -rf .venv .venv-* out build dist
