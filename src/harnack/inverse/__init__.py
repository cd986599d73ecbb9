"""Pictures with derivatives: `picture`, which draws a surface as a tensor that an optimization can
differentiate, with silhouettes."""
