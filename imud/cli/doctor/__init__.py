"""`imud doctor`: looks for what is wrong, and says what to do next. Each subject is a module of checks."""
