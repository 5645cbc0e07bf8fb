"""The reference measurement of priors: cubes that nobody trained on."""
