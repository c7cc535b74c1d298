"""Input and output: YAML with positions, JSON, Parquet, saved states, shipped files."""
