"""What is installed, what of it works here, and what to do about what does not.

Whatever could crash, hang or leave something behind runs in processes of its own (`probes`); `examination`
starts them and puts their answers beside what this process finds out by itself (`checks`).
"""
