"""Training of DeepPointMap: samples of posed scans, the objective, the step, the loop, and the recall that selects.

The public names are those of `dpmjax.deeppointmap`.
"""
