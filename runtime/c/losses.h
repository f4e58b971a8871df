/* The robust losses by number. */
#ifndef EPIGAUGE_LOSSES_H
#define EPIGAUGE_LOSSES_H

#include "epigauge_kernels.h"

/* In the order of epigauge.two_view.losses.LOSSES. */
enum { EG_LINEAR, EG_HUBER, EG_SOFT_L1, EG_CAUCHY, EG_TRUNCATED };

/* Loss of squared residuals with its first two derivatives. */
void eg_losses(int loss, double scale2, ptrdiff_t n, const double *squared, double *value,
               double *first, double *second);

#endif
