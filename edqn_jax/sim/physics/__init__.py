"""The drone: airframe, controller, one physics step, disturbances."""
