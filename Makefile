# One file of commands for people and CI. Everything lives in .venv; the lock files say what is in it.

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALL := $(PIP) install --require-hashes --only-binary :all:
PYTEST := $(BIN)/python -m pytest -n auto --dist worksteal
comma := ,

.PHONY: setup run test test-long test-socketcan coverage mutation lint bench clean lock install-target

setup: $(VENV)/project.stamp
	@set -- $$CC; for compiler in $$1 cc gcc clang; do \
	    if path=$$(command -v "$$compiler"); then echo "C compiler: $$path"; exit 0; fi; \
	done; \
	$(MAKE) --silent $(VENV)/ziglang.stamp && echo "C compiler: none found, using Python package ziglang in $(VENV)"

run: setup
	$(BIN)/xilgate drive

test: setup $(VENV)/dev.stamp
	$(PYTEST)

# What takes minutes to hours; what it measured becomes docs/evidence.md.
test-long: setup $(VENV)/dev.stamp
	$(PYTEST) -m long --evidence

# What needs a real SocketCAN interface; a machine whose kernel has no CAN runs it in a guest (Debian package user-mode-linux).
test-socketcan: setup $(VENV)/dev.stamp
	@if ip link show vcan0 up >/dev/null 2>&1; then run=; else run=tests/support/vcan_guest.sh; fi; \
	$$run $(BIN)/python -m pytest -p no:cacheprovider tests/dbc/test_link.py tests/socketcan

# What decides about a car, by the tests of it alone; both lists are those of [tool.mutmut].
MUTMUT = $(shell $(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["tool"]["mutmut"]["$(1)"], sep="$(2)")')
coverage: setup $(VENV)/dev.stamp
	$(BIN)/coverage run --include=$(call MUTMUT,only_mutate,$(comma)) -m pytest $(call MUTMUT,pytest_add_cli_args_test_selection, )
	$(BIN)/coverage report

# Takes a quarter of an hour on a quiet machine. mutmut keeps what has not changed in mutants/, but does not see all that has.
mutation: setup $(VENV)/dev.stamp
	rm -rf mutants
	PATH="$(CURDIR)/$(BIN):$$PATH" mutmut run
	$(BIN)/python -m tests.support.survivors

lint: setup $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: setup
	$(BIN)/xilgate bench solver
	$(BIN)/xilgate bench gateway

# The gateway as a daemon of a target: docs/target.md. DESTDIR=DIRECTORY puts everything below a directory, for a package or an image.
PREFIX := /opt/xilgate
TARGET := $(DESTDIR)$(PREFIX)
SYSTEM := $(DESTDIR)/usr/local/lib
TARGET_PIP := $(TARGET)/bin/python -m pip --disable-pip-version-check --quiet
install-target:
	python3 -m venv $(TARGET)
	$(TARGET_PIP) install --require-hashes --only-binary :all: -r requirements.lock
	$(TARGET_PIP) install --no-deps --no-build-isolation --no-index --force-reinstall .
	@# What pip wrote names the place that it was put together in.
	sed -i '1s|^#!$(TARGET)/|#!$(PREFIX)/|' $$(grep -lI '^#!$(TARGET)/' $(TARGET)/bin/*)
	install -D -m 644 docs/*.md -t $(TARGET)/share/doc
	install -D -m 644 gateway/target/xilgate-gateway.service gateway/target/xilgate-controller.service -t $(SYSTEM)/systemd/system
	install -D -m 644 gateway/target/80-xilgate-can0.network -t $(SYSTEM)/systemd/network
	install -D -m 644 gateway/target/80-xilgate-can.rules -t $(SYSTEM)/udev/rules.d
	install -D -m 644 gateway/target/xilgate.sysusers.conf $(SYSTEM)/sysusers.d/xilgate.conf
	install -D -m 644 gateway/target/xilgate.tmpfiles.conf $(SYSTEM)/tmpfiles.d/xilgate.conf
	install -d -m 750 $(DESTDIR)/etc/xilgate
	@for file in gateway/target/rig.toml dbc/robots.dbc dbc/gnss_imu.dbc dbc/focus.toml; do \
	    test -e $(DESTDIR)/etc/xilgate/$${file##*/} || install -m 644 $$file -t $(DESTDIR)/etc/xilgate || exit 1; \
	done
	@echo "installed in $(TARGET); what is left to do: $(PREFIX)/share/doc/target.md"

clean:
	rm -rf $(VENV) build dist mutants .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

# The lock files, brought up to pyproject.toml; needs uv. What builds the project is locked with what runs it.
BUILD_REQUIRES := import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], "editables", sep="\n")
LOCK := UV_CUSTOM_COMPILE_COMMAND="make lock" uv pip compile --quiet --generate-hashes --universal --fork-strategy fewest --python-version 3.11
lock:
	python3 -c '$(BUILD_REQUIRES)' | $(LOCK) pyproject.toml - --output-file requirements.lock
	python3 -c '$(BUILD_REQUIRES)' | $(LOCK) pyproject.toml - --extra dev --constraint requirements.lock --output-file requirements-dev.lock
	echo ziglang | $(LOCK) - --output-file requirements-ziglang.lock

$(VENV)/python.stamp:
	@for python in python3 python3.11 python3.12 python3.13 python3.14; do \
	    if $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	        echo "Setting up $(VENV) with $$($$python --version)"; \
	        $$python -m venv $(VENV) || { echo "setup: cannot make $(VENV); on Debian: apt-get install python3-venv" >&2; exit 1; }; \
	        touch $@; exit 0; \
	    fi; \
	done; \
	echo "setup: Python 3.11 or newer is needed, found $$(python3 --version 2>/dev/null || echo none)" >&2; exit 1

$(VENV)/run.stamp: requirements.lock $(VENV)/python.stamp
	@echo "Installing $<"
	@$(INSTALL) -r $<
	@touch $@

# Without build isolation nothing unpinned is fetched.
$(VENV)/project.stamp: pyproject.toml $(VENV)/run.stamp
	@$(PIP) install --no-deps --no-build-isolation --no-index --editable .
	@touch $@

$(VENV)/dev.stamp: requirements-dev.lock $(VENV)/run.stamp
	@echo "Installing $<"
	@$(INSTALL) -r $<
	@touch $@

$(VENV)/ziglang.stamp: requirements-ziglang.lock $(VENV)/run.stamp
	@echo "Installing $<"
	@$(INSTALL) -r $<
	@touch $@
