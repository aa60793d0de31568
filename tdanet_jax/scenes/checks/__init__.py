"""How well the rooms agree with AI2-THOR."""
