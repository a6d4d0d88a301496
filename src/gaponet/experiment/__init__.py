"""Experiments that answer one question each: run, tables, figures and sentences in one folder, one report over all."""
