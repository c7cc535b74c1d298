"""Files in and out: YAML with positions, Parquet, folders that are written whole, shipped data and names."""
