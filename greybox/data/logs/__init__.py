"""Log readers, one file per format. All unit, sign and frame conversion happens here and nowhere else."""
