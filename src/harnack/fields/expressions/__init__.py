"""Fields that users write as formulas."""
