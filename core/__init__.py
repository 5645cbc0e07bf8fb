"""The conventions of the project, one module each. numpy only; imports nothing of ours."""
