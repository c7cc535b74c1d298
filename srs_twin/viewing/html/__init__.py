"""Reports as single HTML pages without external resources."""
