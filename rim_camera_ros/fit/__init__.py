"""The joint adjustment: recordings as stations (`data`), their prediction, normal equations, solver.

`design` holds regressors that no effect has, `variance_components` sizes of random effects, `decimation` the
coarser grid on which large sensors are looked at.
"""
