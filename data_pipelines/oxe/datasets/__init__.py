"""What is known of each dataset: one module a laboratory, robot or benchmark. See `oxe.registry` for the table.

Facts, unless a module says otherwise: the feature descriptions of https://www.tensorflow.org/datasets/catalog (each
dataset's page) and the projects that are named as source. What these leave open is from ``oxe/transforms`` of
https://github.com/octo-models/octo and https://github.com/openvla/openvla, or from whom the notes name. Frequencies:
the data sheet of https://robotics-transformer-x.github.io. Pictures with red and blue exchanged: ``prepare_open_x.sh``
of https://github.com/kpertsch/rlds_dataset_mod, which octo's and openvla's copies went through.
"""
