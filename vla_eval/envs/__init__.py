"""Environments: the ManiSkill adapter, an arrays-only fake, and the factory that chooses."""
