"""Judges topology files by our JSON Schema with the package `jsonschema`: schema.py SCHEMA FILE...

Prints one JSON object: for each file the list of what is wrong with it.
"""

import json
import sys
import tomllib

from jsonschema import Draft202012Validator

with open(sys.argv[1], encoding="utf-8") as file:
    schema = json.load(file)
Draft202012Validator.check_schema(schema)
validator = Draft202012Validator(schema)
found = {}
for path in sys.argv[2:]:
    with open(path, "rb") as file:
        topology = tomllib.load(file)
    found[path] = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(topology)]
json.dump(found, sys.stdout)
