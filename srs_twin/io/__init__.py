"""Readers and writers of YAML, JSON, Parquet and saved-state files."""
