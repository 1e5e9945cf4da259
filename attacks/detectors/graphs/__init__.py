"""TensorFlow.js graph models as differentiable torch modules."""
