"""The paper's tables and figures, reproduced and compared with this project's methods."""
