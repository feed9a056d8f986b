"""The joint adjustment: recordings as stations (`data`), their prediction, normal equations, solver.

`design` holds the regressors that are not parameters of effects, `variance_components` the sizes of random
effects, `decimation` the coarser grid on which recordings of large sensors are fitted first.
"""
