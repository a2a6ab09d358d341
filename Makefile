# make setup | demo | test | test-fast | faults | lint | coverage | docs | bench | wheel | gpu-check | gpu-train    (see README.md)
PYTHON ?= python3
VENV   ?= .venv
# Any newer torch works as well, e.g. `make setup TORCH=torch`.
TORCH  ?= torch==2.13.0
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.PHONY: setup demo test test-fast faults coverage lint docs bench wheel gpu-check gpu-train clean

setup: $(READY)

$(READY): pyproject.toml setup.py setup.cfg
	$(PYTHON) -c 'import sys; v = sys.version_info; ok = (3, 10) <= v[:2] <= (3, 13); sys.exit(0 if ok else "Python 3.10 to 3.13 is needed, this is %d.%d; name one with PYTHON=python3.x" % v[:2])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "$(TORCH)"
	$(BIN)/python -m pip install --quiet --use-pep517 -e ".[all]"
	touch $@

demo: $(READY)
	$(BIN)/dyfn-demo bags/demo --out out/demo

test: $(READY)
	$(BIN)/python -m pytest

test-fast: $(READY)
	$(BIN)/python -m pytest -m "not slow"

# Does every fault of docs/faults.md to the node, writes what came of it there, and fuzzes every topic.
faults: $(READY)
	$(BIN)/python -m tests.support.faults.table --write
	DYFN_FUZZ=2000 $(BIN)/python -m pytest tests/ros/node/test_fuzz.py

coverage: $(READY)
	$(BIN)/python -m pytest --cov --cov-report=term

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(READY)
	$(BIN)/mkdocs build

bench: $(READY)
	mkdir -p out
	$(BIN)/python benchmarks/speed.py --out out/speed.json --page docs/PERFORMANCE.md
	$(BIN)/python benchmarks/backends.py

gpu-check: $(READY)
	$(BIN)/python benchmarks/gpu_check.py

# e.g. make gpu-train GPU_TRAIN="--art out/art --minutes 10"      (see docs/training.md)
gpu-train: $(READY)
	$(BIN)/python benchmarks/gpu_train.py $(GPU_TRAIN)

wheel:
	rm -rf dist build
	$(PYTHON) -m venv $(VENV)-wheel
	$(VENV)-wheel/bin/python -m pip install --quiet build twine
	$(VENV)-wheel/bin/python -m build --outdir dist .
	$(VENV)-wheel/bin/python -m twine check --strict dist/*

clean:
	rm -rf $(VENV) $(VENV)-wheel dist build install log out
