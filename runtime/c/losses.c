#include "losses.h"

void eg_losses(int loss, double scale2, ptrdiff_t n, const double *squared, double *value,
               double *first, double *second)
{
    switch (loss) {
    case EG_HUBER:
        eg_loss_huber(n, squared, &scale2, value, first, second);
        break;
    case EG_SOFT_L1:
        eg_loss_soft_l1(n, squared, &scale2, value, first, second);
        break;
    case EG_CAUCHY:
        eg_loss_cauchy(n, squared, &scale2, value, first, second);
        break;
    case EG_TRUNCATED:
        eg_loss_truncated(n, squared, &scale2, value, first, second);
        break;
    default:
        for (ptrdiff_t i = 0; i < n; ++i) {
            value[i] = squared[i];
            first[i] = 1.0;
            second[i] = 0.0;
        }
    }
}
