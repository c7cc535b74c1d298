"""What is installed, what of it works here, and what to do about what does not.

Everything that could crash, hang or leave something behind is tried in a child process (`children`,
`probes`). What came back is judged by functions that do nothing else, so that each remedy can be tested.
"""
