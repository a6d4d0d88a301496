"""Experiments: trainings and measurements that become tables, figures and sentences in one
folder.
"""
