"""Reports: one page of HTML each, which needs nothing but a browser."""
