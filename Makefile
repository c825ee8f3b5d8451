# All set-up happens in .venv; targets are quick the second time.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip install --disable-pip-version-check --quiet

.PHONY: demo demo-rl test lint bench paper paper-all clean

demo: $(VENV)/.run ## Let the explorer drive Killian Court, write the figures, print the scores
	$(BIN)/python scripts/run_knn.py

demo-rl: $(VENV)/.learn ## Let a learned agent drive Killian Court, write the figures, print the scores
	$(BIN)/python scripts/run_agent.py ppo_headings

test: $(VENV)/.dev ## Run all tests, on all cores
	$(BIN)/python -m pytest -n auto --dist loadfile

lint: $(VENV)/.dev ## Style, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: $(VENV)/.run ## Measure the speed
	$(BIN)/python scripts/benchmark.py

paper: $(VENV)/.paper ## Reproduce the paper and test its claims: a report with figures in out/paper
	$(BIN)/python scripts/reproduce_paper.py

paper-all: $(VENV)/.paper ## The same, with variations of how the paper is read and a sweep of the noise
	$(BIN)/python scripts/reproduce_paper.py --all

compare: $(VENV)/.paper ## Compare agents in the default suite: a table, a report and a page with replays in out/compare
	$(BIN)/python scripts/compare.py

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: $(BIN)/python pyproject.toml constraints.txt
	$(PIP) -c constraints.txt -e ".[cli,plot,render]"
	touch $@

$(VENV)/.paper: $(VENV)/.run
	$(PIP) -c constraints.txt -e ".[paper]"
	touch $@

$(VENV)/.learn: $(VENV)/.run
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) -c constraints.txt -e ".[train,plot,render]"
	touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml constraints.txt
	$(PIP) "$$(grep '^torch==' constraints.txt)"
	$(PIP) -c constraints.txt -e ".[dev]"
	touch $@ $(VENV)/.run $(VENV)/.learn

clean: ## Remove the virtual environment and everything written
	rm -rf $(VENV) out
