"""How do the priors of deepinv see the camera of a recipe?

As a linear operator from a scene to a frame, with noise and likelihood of the sensor, in the
classes of deepinv.
Offers: `recipe_physics.as_physics`, `deepinv_camera.CameraPhysics`, `deepinv_camera.SensorNoise`,
        `deepinv_camera.SensorLikelihood`.
"""
