"""What a cell is.

records: the frozen description. file, reader, sections, task, robots: from TOML to it, with checks.
decision: the decision vector. archive: the bundle of all files that a stored trajectory carries.
"""
