"""Environments: the ManiSkill adapter, an arrays-only fake, the factory. Knows nothing of policies."""
