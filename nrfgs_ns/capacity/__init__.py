# SPDX-License-Identifier: Apache-2.0
"""`--pipeline.model.capacity auto`: while a model trains, drop the parts of its field that do not pay.

Some training views are set aside from the first step (`aside.py`). After a given step each part is taken out in turn,
the smaller field settles on the other views as the whole one does (`settle.py`), and the views that were set aside say
which of the two is worth more (`search.py`). The smallest field within the tolerance takes the model's place, optimiser
state included (`install.py`), the decision is logged with its evidence (`schedule.py`), and the views go back to the
training.
"""
