"""Tells nerfbaselines of the protocols: the target of the entry point ``nerfbaselines.specs``, which it imports.

Nothing else may import this module: it needs nerfbaselines.
"""

from nerfbaselines import register

for _name in ("WholeImage", "VisibleOnly", "Proper", "PaperText", "PaperCode"):
    _id = "unghost" + "".join("-" + each.lower() if each.isupper() else each for each in _name)
    register({"id": _id, "evaluation_protocol_class": f"unghost.integrations.nerfbaselines.protocol:{_name}"})
