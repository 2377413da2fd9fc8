"""The MIKASA-Robo tasks; `catalog` names them without a simulator. Knows nothing of policies."""
