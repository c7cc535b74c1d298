.PHONY: test fast slow check docs golden

test:    ## the tests of every change
	uv run pytest

fast:    ## those that take under a minute together
	uv run pytest -m "fast and not slow"

slow:    ## those that `make test` leaves out
	uv run pytest -m slow

check:   ## lint, layout, types
	uv run ruff check
	uv run ruff format --check
	uv run mypy

docs:    ## the site, site/index.html
	uv run sphinx-build -W -c docs . site

golden:  ## digests of all shipped results against benchmarks/golden.json
	uv run python benchmarks/golden.py
