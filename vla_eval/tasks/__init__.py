"""The MIKASA-Robo tasks. `catalog` names them without importing a simulator."""
