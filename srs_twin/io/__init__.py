"""Input and output: YAML with positions, JSON, Parquet, saved states, atomic writes, shipped files."""
