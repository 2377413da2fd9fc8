"""Environments: the ManiSkill adapter, an arrays-only stand-in, and the factory that chooses."""
