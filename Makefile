.PHONY: test fast slow check docs golden paper

test:    ## the tests of every change
	uv run --group dev pytest

fast:    ## those that take under a minute together
	uv run --group dev pytest -m "fast and not slow"

slow:    ## those that `make test` leaves out
	uv run --group dev pytest -m slow

check:   ## lint, layout, types
	uv run --group dev ruff check
	uv run --group dev ruff format --check
	uv run --group dev mypy

docs:    ## the site, site/index.html
	uv run --group dev sphinx-build -W -c docs . site

golden:  ## digests of all shipped results against tools/golden.json
	uv run --group dev python tools/golden.py

paper:   ## the figures of the paper
	uv run python paper/figures.py
