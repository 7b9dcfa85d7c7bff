"""A user's log of training: lines of JSON in the run folder."""

import json


class Lines:
    def __init__(self, folder, spec):
        self.file = (folder / "log.jsonl").open("a")
        self.scalars({"seed": spec["seed"]}, -1)

    def scalars(self, values, step):
        self.file.write(json.dumps([step, values]) + "\n")

    def close(self):
        self.file.close()
