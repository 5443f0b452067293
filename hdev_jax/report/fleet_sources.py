import numpy as np
__all__=[]
GRADE_EDGES = np.linspace(-10.0, 10.0, 21)
ACCEL_EDGES = np.linspace(-2.0, 2.0, 17)
