"""The command ``fluoromap``."""
