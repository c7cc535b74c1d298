"""Readers and writers of YAML, JSON, Parquet, saved states and shipped files."""
