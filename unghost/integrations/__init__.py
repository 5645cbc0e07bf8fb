"""Plug-ins for other programs: nerfstudio, nerfbaselines."""
