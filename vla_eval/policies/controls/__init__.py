"""Scripted controls: policies without a model, against which a learned one is measured."""
