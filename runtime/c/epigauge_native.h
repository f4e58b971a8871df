/* Loops over the generated kernels: what would cost too much in Python.

   Nothing here is a formula of the geometry; those are printed by `make derive`. */
#ifndef EPIGAUGE_NATIVE_H
#define EPIGAUGE_NATIVE_H

#include "epigauge_kernels.h"

EG_EXPORT int eg_processor_level(void);

#endif
