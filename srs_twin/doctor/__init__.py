"""What is installed, what of it works here, and what to do about what does not.

Whatever could crash, hang or leave something behind runs in processes of its own (`children`, `probes`);
`examination` puts their answers beside what this process finds out by itself (`packages`, `machine`).
"""
